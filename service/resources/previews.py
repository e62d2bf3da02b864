"""Previews: what captures would be as datasets, of which nothing is stored."""

from typing import Self

from fastapi import APIRouter
from pydantic import ConfigDict, Field

from service.http.dependencies import SettingsDep, StoreDep
from service.http.errors import BODY_PROBLEMS, problems
from service.http.uploads import FilesBody
from service.resources.dataset_bodies import read_new
from service.resources.datasets import DESCRIBED, NEW_DATASET, DatasetFacts
from service.wire.people import ViewPeoplePreview
from service.wire.schemas import Name, Vector2
from store import datasets, records
from store.capture import Capture

router = APIRouter(prefix="/previews", tags=["datasets"])


class DatasetPreview(DatasetFacts):
    """What a capture would be as a dataset; nothing was stored."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                **DESCRIBED,
                "frame": 12,
                "people": None,
                "frame_keypoints": [[[512.0, 200.5], None], [[301.0, 190.0], [322.5, 251.0]]],
            }
        }
    )

    frame: int = Field(description="The first of the frames that show most keypoints.")
    frame_keypoints: list[list[Vector2 | None]] = Field(
        description="Keypoints of this frame: views x keypoints x (x, y), pixels, null where not "
        "observed."
    )
    people: list[ViewPeoplePreview] | None = Field(
        description="Of `files` in which a view shows several people: those of each view, so that "
        "`person` can name one of each."
    )

    @classmethod
    def of(
        cls,
        record: records.DatasetRecord,
        capture: Capture,
        people: list[ViewPeoplePreview] | None = None,
    ) -> Self:
        """Return the wire form of what would be stored."""
        there = capture.seen
        frame = int(there.sum(axis=(1, 2)).argmax())
        shown = [
            [point.tolist() if known else None for point, known in zip(view, seen, strict=True)]
            for view, seen in zip(capture.keypoints[frame], there[frame], strict=True)
        ]
        return cls(frame=frame, frame_keypoints=shown, people=people, **cls.known(record))


@router.post("", responses=problems(*BODY_PROBLEMS), openapi_extra=NEW_DATASET)
def preview_dataset(
    upload: FilesBody,
    store: StoreDep,
    settings: SettingsDep,
    name: Name | None = None,
) -> DatasetPreview:
    """Answer what is understood of a capture, with a frame of it, and store nothing.

    It takes what `POST /datasets` takes, and refuses what that refuses.
    """
    capture, description, people = read_new(upload, settings, name, with_people=True)
    return DatasetPreview.of(datasets.described(store, capture, description), capture, people)
