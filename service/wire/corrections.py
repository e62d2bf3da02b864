"""The JSON form of corrected keypoints."""

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

from models.settings.keypoints import MAX_KEYPOINTS, MAX_VIEWS
from store import corrections
from store.corrections import FARTHEST, MOST, Place

Pixels = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST, allow_inf_nan=False)]


class KeypointPlace(BaseModel):
    """A keypoint of a view in a frame; all are counted from 0."""

    model_config = ConfigDict(extra="forbid")

    frame: int = Field(ge=0, lt=2**53)
    view: int = Field(ge=0, lt=MAX_VIEWS)
    keypoint: int = Field(ge=0, lt=MAX_KEYPOINTS)

    def place(self) -> Place:
        """Return it as the store has it."""
        return Place(self.frame, self.view, self.keypoint)


class Correction(KeypointPlace):
    """Where a keypoint really is."""

    position: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = Field(
        description="x and y in pixels of the view's image, inside it or near; null removes the "
        "keypoint: it is not observed."
    )

    def stored(self) -> corrections.Correction:
        """Return it as the store has it."""
        if self.position is None:
            return corrections.Correction(self.place(), None)
        x, y = self.position
        return corrections.Correction(self.place(), (x, y))

    @classmethod
    def of(cls, correction: corrections.Correction) -> Self:
        """Return the JSON form of a stored one."""
        position = correction.position
        return cls(**correction.place._asdict(), position=position and list(position))


class CorrectionsState(BaseModel):
    """Which corrections a dataset has, or a job was made with."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"count": 2, "checksum": f"sha256:{'9c1f' * 16}"}}
    )

    count: int = Field(description="How many keypoints are corrected or removed.")
    checksum: str | None = Field(
        description="Of all of them: where it is the same, they are. Null without any."
    )

    @classmethod
    def of(cls, record: Any) -> Self:
        """Return those of a record."""
        known = record.corrections_checksum
        return cls(count=record.corrections_count, checksum=known and f"sha256:{known}")


class CorrectionsChange(BaseModel):
    """What to correct, and which corrections to undo."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "correct": [
                    {"frame": 118, "view": 1, "keypoint": 3, "position": [412.5, 230.0]},
                    {"frame": 119, "view": 1, "keypoint": 3, "position": None},
                ],
                "undo": [{"frame": 90, "view": 0, "keypoint": 7}],
            }
        },
    )

    correct: list[Correction] = Field(
        [],
        max_length=MOST,
        description="They replace earlier corrections of the same keypoints in the same frames.",
    )
    undo: list[KeypointPlace] = Field(
        [],
        max_length=MOST,
        description="Keypoints that are again as they were detected; where nothing was corrected, "
        "nothing changes.",
    )
