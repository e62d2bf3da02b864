"""The bodies that datasets are made of: JSON, arrays, and files of detectors."""

from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from models.settings.keypoints import MAX_VIEWS
from models.settings.times import MAX_FPS, MIN_FPS, check_rate
from service.http.errors import invalid
from service.http.uploads import HOW_TO_SEND_FILES, Upload
from service.resources.changes import Change
from service.settings import Settings
from service.wire.arrays import Arrays
from service.wire.calibrations import CaptureCalibration
from service.wire.captures import read_arrays, to_capture
from service.wire.detector_files import DetectorReading, asked_of, holds_arrays, read_files
from service.wire.json_bodies import read_json
from service.wire.people import ViewPeoplePreview
from service.wire.schemas import CONFIDENCE, KEYPOINTS, POINTS3D, TIMES, Name
from service.wire.skeletons import Skeleton
from store.capture import Capture
from store.capture_files import UNKNOWN_SIZE
from store.datasets import CaptureDescription
from store.labels import Labels, Text
from store.records import DatasetRecord

CAPTURE_ARRAYS = frozenset({"keypoints", "confidence", "points3d", "times"})
DESCRIPTION_ARRAYS = frozenset({"keypoint_names", "edges", "image_sizes", "fps", "view_names"})
OF_DETECTORS = {"people", "annotations", "instance_info", "landmarks"}  # fields of their JSON
MAX_LISTED = 10_000  # values of an array that describes

ViewName = Annotated[Text, Field(min_length=1, max_length=200)]
ImageSize = Annotated[
    list[Annotated[int, Field(ge=1, le=100_000)]], Field(min_length=2, max_length=2)
]


class CaptureFacts(BaseModel):
    """What may be known of a capture besides its arrays, at once or later."""

    skeleton: Skeleton | None = None
    view_names: list[ViewName] | None = Field(
        None,
        max_length=MAX_VIEWS,
        description="One name per view, such as those of the cameras.",
    )
    image_sizes: list[ImageSize | None] | None = Field(
        None,
        max_length=MAX_VIEWS,
        description="Width and height in pixels of each view's images, null if unknown.",
    )
    fps: float | None = Field(
        None,
        ge=MIN_FPS,
        le=MAX_FPS,
        description="Frames per second, if the frames follow each other in time: views that are "
        "out of step are then found and shifted (`synchronise` of a fit).",
    )
    calibration: CaptureCalibration | None = Field(
        None,
        description="Cameras that are known, kept for fits that name them (`calibration` of a fit "
        "is `dataset`). Of `files`: those of a calibration file among them, if not given.",
    )

    def suit(self, views: int, keypoints: int) -> None:
        """Raise ``ApiError`` unless a capture of so many views and keypoints may have them."""
        if self.skeleton is not None:
            self.skeleton.check(keypoints)
        for field in ("image_sizes", "view_names"):
            given = getattr(self, field)
            if given is not None and len(given) != views:
                raise invalid(f"/{field}", f"expected one per view ({views}), got {len(given)}")
        known = self.calibration
        if known is not None and {len(known.cameras), len(known.names or known.cameras)} != {views}:
            raise invalid("/calibration/cameras", f"expected one per view ({views})")


class DatasetChange(CaptureFacts, Change):
    """What to change of a dataset; what is left out stays as it is.

    So do labels that are null. Of all else null removes what is there.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "skeleton": {"keypoint_names": ["nose", "neck"], "edges": [[0, 1]]},
                "image_sizes": [[1280, 1024], [1280, 1024]],
                "fps": 50.0,
            }
        },
    )

    def columns(self) -> dict[str, Any]:
        """Return the record's columns that change, with their new values."""
        facts = self.model_dump(include=self.model_fields_set & set(CaptureFacts.model_fields))
        return super().columns() | facts

    def check(self, record: DatasetRecord) -> None:
        """Raise ``ApiError`` for what this dataset cannot be changed to."""
        self.suit(record.views, record.keypoints)


class DatasetDescription(CaptureFacts, Labels):
    """The description of a capture besides its arrays."""

    name: Name = "capture"

    def describe(self, capture: Capture) -> CaptureDescription:
        """Return the description, checked against the capture it describes."""
        views, keypoints = capture.keypoints.shape[1:3]
        self.suit(views, keypoints)
        known = self.calibration
        if self.fps is not None and capture.times is not None:
            try:
                check_rate(self.fps, capture.times)
            except ValueError as error:
                raise invalid("/fps", str(error)) from error
        return CaptureDescription(
            name=self.name,
            skeleton=self.skeleton.model_dump() if self.skeleton else None,
            view_names=self.view_names,
            image_sizes=self.image_sizes,
            fps=self.fps,
            calibration=None if known is None else known.model_dump(mode="json"),
            labels=self,
        )


class Frames(BaseModel):
    """Frames of a capture."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "keypoints": [
                    [
                        [[512.0, 200.5], [530.0, 260.0], None, [498.0, 402.0]],
                        [[301.0, 190.0], [322.5, 251.0], [350.0, 330.0], [310.0, 399.0]],
                    ]
                ]
            }
        },
    )

    keypoints: KEYPOINTS
    confidence: CONFIDENCE = None
    points3d: POINTS3D = None
    times: TIMES = None


class DatasetCreate(DatasetDescription, Frames):
    """A capture and its description."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "name": "macaque, morning session",
                "keypoints": Frames.model_config["json_schema_extra"]["example"]["keypoints"],  # type: ignore[index,call-overload]
                "skeleton": {
                    "keypoint_names": ["nose", "neck", "elbow", "wrist"],
                    "edges": [[0, 1], [1, 2], [2, 3]],
                },
                "image_sizes": [[1280, 1024], [1280, 1024]],
                "fps": 50.0,
                "tags": ["pilot"],
                "metadata": {"subject": "M7"},
            }
        },
    )

    @model_validator(mode="before")
    @classmethod
    def _no_file(cls, value: Any) -> Any:
        """Refuse a detector's JSON that was posted as it is, with how to send it."""
        names = value.keys() if isinstance(value, dict) else set()
        if isinstance(value, list) or names & OF_DETECTORS:
            raise ValueError(f"expected an object with `keypoints`. {HOW_TO_SEND_FILES}")
        return value


class DatasetForm(DetectorReading, DatasetDescription):
    """The fields of a form besides its files."""


class NewCapture(NamedTuple):
    """A capture in a body, its description, and whom each view shows, if it was asked for."""

    capture: Capture
    description: CaptureDescription
    people: list[ViewPeoplePreview] | None = None


def read_new(
    upload: Upload,
    settings: Settings,
    name: str | None,
    *,
    with_people: bool = False,
    may_keep: int | None = None,
) -> NewCapture:
    """Return the capture in a body.

    Parameters
    ----------
    may_keep
        Bytes that who sends it may still keep, if that is bounded.

    Raises
    ------
    ApiError
        If the body cannot be read, or is invalid.
    """
    if upload.is_json:
        body = read_json(upload, DatasetCreate)
        notes: list[str] = []
        capture = _capture_of(body, upload, settings, notes)
        return NewCapture(capture, replace(body.describe(capture), notes=notes))
    people = None
    fields: dict[str, Any] = {"name": name} if name is not None else {}
    reading, upload = asked_of(upload)
    if upload.files and (reading or not holds_arrays(upload)):
        known = upload.form(DatasetDescription, fields, DatasetForm)
        found, described, notes, people = read_files(
            upload,
            reading,
            settings,
            fps=known.fps,
            image_sizes=known.image_sizes,
            with_people=with_people,
            may_keep=may_keep,
        )
        fields |= described
    elif reading:
        raise invalid(f"/{next(iter(reading))}", "expected beside `files` only, not beside arrays")
    else:
        found = read_arrays(upload, CAPTURE_ARRAYS | DESCRIPTION_ARRAYS)
        fields |= _described_in(found)
        notes = []
    capture = _capture_in(found, settings, notes)
    description = upload.form(DatasetDescription, fields, DatasetForm).describe(capture)
    return NewCapture(capture, replace(description, notes=notes), people)


def _described_in(found: Arrays) -> dict[str, Any]:
    """Return the fields of a description that are in the arrays of a capture."""
    fields: dict[str, Any] = {}
    skeleton = {key: _listed(found, key) for key in ("keypoint_names", "edges") if key in found}
    if skeleton:
        fields["skeleton"] = skeleton
    for key in ("image_sizes", "view_names"):
        if key in found:
            fields[key] = _listed(found, key)
    if isinstance(fields.get("image_sizes"), list):
        fields["image_sizes"] = [None if s == UNKNOWN_SIZE else s for s in fields["image_sizes"]]
    if "fps" in found:
        fps = _listed(found, "fps")
        fields["fps"] = fps[0] if isinstance(fps, list) and len(fps) == 1 else fps
    return fields


def read_frames(upload: Upload, settings: Settings) -> Capture:
    """Return the frames in a body.

    Raises
    ------
    ApiError
        If the body cannot be read.
    """
    if upload.is_json:
        body = read_json(upload, Frames)
        return _capture_of(body, upload, settings)
    return _capture_in(read_arrays(upload, CAPTURE_ARRAYS), settings)


def _capture_of(
    body: Frames, upload: Upload, settings: Settings, notes: list[str] | None = None
) -> Capture:
    return to_capture(
        body.keypoints,
        body.confidence,
        body.points3d,
        body.times,
        settings=settings,
        max_bytes=upload.max_array_bytes,
        notes=notes,
    )


def _capture_in(found: Arrays, settings: Settings, notes: list[str] | None = None) -> Capture:
    others = (found.get(name) for name in ("confidence", "points3d", "times"))
    return to_capture(_required(found), *others, settings=settings, notes=notes)


def _listed(found: Arrays, name: str) -> Any:
    if found[name].size > MAX_LISTED:
        raise invalid(f"/{name}", f"expected {MAX_LISTED} values at most, got {found[name].size}")
    if found[name].dtype.kind not in "biufSU":
        raise invalid(f"/{name}", f"expected text or numbers, got {found[name].dtype}")
    try:
        return found[name].tolist()
    except (SystemError, ValueError) as error:  # which one depends on the version of NumPy
        raise invalid(f"/{name}", "expected text, got code points beyond the last") from error


def _required(found: Arrays) -> np.ndarray[Any, Any]:
    if "keypoints" not in found:
        raise invalid(
            "/keypoints",
            "expected an array of this name in the file, shape (frames, views, keypoints, 2)",
        )
    return found["keypoints"]
