"""The JSON form of a skeleton: what the keypoints are called and which of them are joined."""

from collections import Counter
from typing import Annotated

from fewview.readers.skeletons import NAMED
from pydantic import BaseModel, ConfigDict, Field

from models.settings.keypoints import MAX_KEYPOINTS
from service.http.errors import invalid
from store.labels import Text

TITLE = "The usual name of the model or data set that has these keypoints."
KeypointName = Annotated[Text, Field(min_length=1, max_length=100)]
Edge = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]


class Skeleton(BaseModel):
    """What the keypoints are called and which of them are joined."""

    model_config = ConfigDict(extra="forbid")

    keypoint_names: list[KeypointName] | None = Field(
        None,
        max_length=MAX_KEYPOINTS,
        description="One unique name per keypoint, in the order of the arrays.",
    )
    edges: list[Edge] = Field(
        [],
        max_length=5000,
        description=(
            "Pairs of keypoint indices. Where keypoints are noisy, a fit holds those whose lengths"
            " stay the same at these (`bone_lengths`)."
        ),
    )

    def check(self, keypoints: int) -> None:
        """Raise ``ApiError`` if this is no skeleton of so many keypoints."""
        names = self.keypoint_names
        if names is not None and len(names) != keypoints:
            raise invalid(
                "/skeleton/keypoint_names",
                f"expected {keypoints} names, one for each keypoint, got {len(names)}",
            )
        if names is not None and len(set(names)) != keypoints:
            twice, _ = Counter(names).most_common(1)[0]
            raise invalid(
                "/skeleton/keypoint_names",
                f"expected different names, but {twice!r} is there {names.count(twice)} times",
            )
        for index, (a, b) in enumerate(self.edges):
            if a == b or max(a, b) >= keypoints:
                raise invalid(
                    f"/skeleton/edges/{index}",
                    f"expected two different keypoints below {keypoints}, got [{a}, {b}]",
                )


class KnownSkeleton(BaseModel):
    """A skeleton that has a name, as `skeleton_name` of an upload takes it."""

    name: str
    title: str = Field(description=TITLE)
    keypoint_names: list[str]
    edges: list[Edge]


def known_skeletons() -> list[KnownSkeleton]:
    """Return all skeletons that are known by name."""
    return [
        KnownSkeleton(
            name=name,
            title=known.title,
            keypoint_names=list(known.names),
            edges=[list(edge) for edge in known.edges],
        )
        for name, known in NAMED.items()
    ]
