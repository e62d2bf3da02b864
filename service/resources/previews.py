"""Previews: what captures would be as datasets, of which nothing is stored."""

from typing import Annotated, Self

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field

from service.http.dependencies import SettingsDep, StoreDep
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.operations import request_body
from service.http.uploads import FilesBody
from service.resources.dataset_bodies import read_new
from service.resources.datasets import DESCRIBED, NEW_DATASET, DatasetFacts
from service.wire.calibrations import CaptureCalibration
from service.wire.detector_files import read_calibration
from service.wire.people import ViewPeoplePreview
from service.wire.schemas import Name, Vector2
from store import datasets, lookup, records, usage
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
    capture, description, people = read_new(
        upload, settings, name, with_people=True, may_keep=usage.left(store)
    )
    return DatasetPreview.of(datasets.described(store, capture, description), capture, people)


class CalibrationForm(BaseModel):
    """The fields of a form besides its files: there are none."""


class CalibrationPreview(CaptureCalibration):
    """What is understood of a calibration file for a dataset."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                **CaptureCalibration.model_config["json_schema_extra"]["example"],  # type: ignore[index,dict-item]
                "notes": ["calibration.toml is a calibration: ..."],
            }
        }
    )

    notes: list[str] = Field(description="Which cameras were taken for which views.")


@router.post(
    "/calibrations",
    responses=problems(*BODY_PROBLEMS, "not_found"),
    openapi_extra=request_body(
        form=CalibrationForm,
        files="A calibration of Anipose, Pose2Sim, FreeMoCap or caliscope (TOML) or of OpenCV "
        "(YAML, JSON), of all cameras, or a file for each.",
    ),
)
def preview_calibration(
    upload: FilesBody, store: StoreDep, dataset_id: Annotated[str, Query(max_length=200)]
) -> CalibrationPreview:
    """Answer the cameras of a calibration file for the views of a dataset; nothing is stored.

    `cameras` is what a fit of the dataset takes as `calibration` of its `config`.
    """
    dataset = lookup.get(store, records.DatasetRecord, dataset_id)
    if not upload.files or any(file.holds_folders for file in upload.files):
        raise invalid("/files", "expected a calibration file, or one for each camera, as `files`")
    views = dataset.view_names or [f"view {view + 1}" for view in range(dataset.views)]
    known, notes = read_calibration(upload, views)
    return CalibrationPreview(**known.model_dump(), notes=notes)
