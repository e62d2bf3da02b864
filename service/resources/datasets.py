"""Datasets: captures, uploaded whole or streamed in chunks."""

import logging
from datetime import UTC, datetime
from typing import Annotated, Any, Self

import numpy as np
import orjson
from fastapi import APIRouter, Depends, Request, Response, status
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from models.findings.finding import Finding, log_findings
from models.settings.times import MAX_FPS, check_rate
from service.http.dependencies import (
    IdempotencyHeader,
    Identifier,
    SettingsDep,
    StoreDep,
)
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.idempotency import idempotency
from service.http.operations import request_body
from service.http.uploads import Upload, UploadBody
from service.resources.changes import NameChange, add_change_route
from service.resources.pages import Asked, Page, asked_of, page_of
from service.settings import Settings
from service.wire.arrays import Arrays
from service.wire.captures import read_arrays, to_capture
from service.wire.findings import EXAMPLE_FINDINGS, Findings
from service.wire.schemas import CONFIDENCE, KEYPOINTS, POINTS3D, TIMES, Name
from service.wire.skeletons import Skeleton
from store import datasets, lookup, records
from store.capture import Capture
from store.datasets import Description

logger = logging.getLogger(__name__)
router = APIRouter(prefix="/datasets", tags=["datasets"])

CAPTURE_ARRAYS = frozenset({"keypoints", "confidence", "points3d", "times"})
DESCRIPTION_ARRAYS = frozenset({"keypoint_names", "edges", "image_sizes", "fps"})
MAX_LISTED = 10_000  # values of an array that describes

MAX_METADATA = 64 * 1024


def _bounded(value: dict[str, Any]) -> dict[str, Any]:
    try:
        size = len(orjson.dumps(value))
    except orjson.JSONEncodeError as error:  # nested too deeply, integers beyond 64 bits
        raise ValueError(f"expected JSON that can be given back: {error}") from error
    if size > MAX_METADATA:
        raise ValueError(f"expected {MAX_METADATA} bytes of JSON at most, got {size}")
    return value


Metadata = Annotated[dict[str, Any], AfterValidator(_bounded)]
METADATA = "Anything of yours, kept and given back; 64 KiB of JSON at most."
ImageSize = Annotated[
    list[Annotated[int, Field(ge=1, le=100_000)]], Field(min_length=2, max_length=2)
]


class DatasetDescription(BaseModel):
    """What can be said of a capture besides its arrays."""

    model_config = ConfigDict(extra="forbid")

    name: Name = "capture"
    skeleton: Skeleton | None = None
    image_sizes: list[ImageSize | None] | None = Field(
        None, description="Width and height in pixels of each view's images, null if unknown."
    )
    fps: float | None = Field(
        None,
        gt=0,
        le=MAX_FPS,
        description="Frames per second, if the frames follow each other in time: views that are "
        "out of step are then found and shifted (`synchronise` of a fit).",
    )
    metadata: Metadata = Field({}, description=METADATA)

    def describe(self, capture: Capture) -> Description:
        """Return the description, checked against the capture it describes."""
        views, keypoints = capture.keypoints.shape[1:3]
        if self.skeleton is not None:
            self.skeleton.check(keypoints)
        if self.image_sizes is not None and len(self.image_sizes) != views:
            raise invalid(
                "/image_sizes", f"expected one per view ({views}), got {len(self.image_sizes)}"
            )
        if self.fps is not None and capture.times is not None:
            try:
                check_rate(self.fps, capture.times)
            except ValueError as error:
                raise invalid("/fps", str(error)) from error
        return Description(
            name=self.name,
            skeleton=self.skeleton.model_dump() if self.skeleton else None,
            image_sizes=self.image_sizes,
            fps=self.fps,
            metadata=self.metadata,
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
    """A capture and what is said of it."""

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
                "metadata": {"subject": "M7"},
            }
        },
    )


class Dataset(BaseModel):
    """A stored capture."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "name": "macaque, morning session",
                "created_at": "2026-03-01T09:30:00Z",
                "frames": 3309,
                "views": 3,
                "keypoints": 13,
                "missing_fraction": [0.61, 0.66, 0.65],
                "has_confidence": True,
                "has_ground_truth": False,
                "checksum": f"sha256:{'5e88' * 16}",
                "skeleton": None,
                "image_sizes": None,
                "fps": 50.0,
                "has_times": False,
                "metadata": {"subject": "M7"},
                "findings": EXAMPLE_FINDINGS,
            }
        }
    )

    id: str
    name: str
    created_at: datetime
    frames: int
    views: int
    keypoints: int = Field(description="Keypoints per view.")
    missing_fraction: list[float] = Field(
        description="Per view, the share of keypoints over all frames that was not observed."
    )
    has_confidence: bool
    has_ground_truth: bool
    checksum: str = Field(
        description="Of all frames' arrays, the same however the capture was cut into uploads."
    )
    skeleton: Skeleton | None
    image_sizes: list[ImageSize | None] | None
    fps: float | None = Field(description="Frames per second, if they were told.")
    has_times: bool = Field(description="Whether every frame came with its time.")
    metadata: dict[str, Any]
    findings: Findings

    @classmethod
    def of(cls, record: records.Dataset) -> Self:
        """Return the wire form of a record."""
        return cls(
            id=record.id,
            name=record.name,
            created_at=datetime.fromtimestamp(record.created_at, UTC),
            frames=record.frames,
            views=record.views,
            keypoints=record.keypoints,
            missing_fraction=[
                round(1 - seen / (record.frames * record.keypoints), 6) for seen in record.observed
            ],
            has_confidence=record.confidence,
            has_ground_truth=record.ground_truth,
            checksum=f"sha256:{record.checksum}",
            skeleton=Skeleton.model_validate(record.skeleton) if record.skeleton else None,
            image_sizes=record.image_sizes,
            fps=record.fps,
            has_times=record.last_times is not None,
            metadata=record.user_metadata,
            findings=[Finding.model_validate(finding) for finding in record.findings or []],
        )


class DatasetChange(NameChange):
    """What to change of a dataset; what is left out, or null, stays as it is."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"name": "macaque, evening", "metadata": {"subject": "M8"}}}
    )

    metadata: Metadata | None = Field(None, description=f"In place of what it was. {METADATA}")

    def columns(self) -> dict[str, Any]:
        """Return the record's columns that change, with what they are to hold."""
        return super().columns() | (
            {} if self.metadata is None else {"user_metadata": self.metadata}
        )


class DatasetPage(Page[Dataset]):
    """Datasets, newest first."""

    model_config = page_of(Dataset)


def _read_new(upload: Upload, settings: Settings, name: str | None) -> tuple[Capture, Description]:
    if upload.is_json:
        body = upload.json(DatasetCreate)
        return (capture := _capture_of(body, settings)), body.describe(capture)
    found = read_arrays(upload, settings, CAPTURE_ARRAYS | DESCRIPTION_ARRAYS)
    said: dict[str, Any] = {"name": name} if name is not None else {}
    skeleton = {key: _listed(found, key) for key in ("keypoint_names", "edges") if key in found}
    if skeleton:
        said["skeleton"] = skeleton
    if "image_sizes" in found:
        said["image_sizes"] = _listed(found, "image_sizes")
    if "fps" in found:
        fps = found["fps"]
        said["fps"] = fps.item() if fps.size == 1 else _listed(found, "fps")
    description = upload.form(DatasetDescription, said)
    capture = _capture_in(found, settings)
    return capture, description.describe(capture)


def _read_frames(upload: Upload, settings: Settings) -> Capture:
    if upload.is_json:
        body = upload.json(Frames)
        return _capture_of(body, settings)
    return _capture_in(read_arrays(upload, settings, CAPTURE_ARRAYS), settings)


def _capture_of(body: Frames, settings: Settings) -> Capture:
    return to_capture(body.keypoints, body.confidence, body.points3d, body.times, settings=settings)


def _capture_in(found: Arrays, settings: Settings) -> Capture:
    others = (found.get(name) for name in ("confidence", "points3d", "times"))
    return to_capture(_required(found), *others, settings=settings)


def _listed(found: Arrays, name: str) -> Any:
    if found[name].size > MAX_LISTED:
        raise invalid(f"/{name}", f"expected {MAX_LISTED} values at most, got {found[name].size}")
    return found[name].tolist()


def _required(found: Arrays) -> np.ndarray[Any, Any]:
    if "keypoints" not in found:
        raise invalid(
            "/keypoints",
            "expected an array of this name in the file, shape (frames, views, keypoints, 2)",
        )
    return found["keypoints"]


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(*BODY_PROBLEMS, "idempotency_key_reused"),
    openapi_extra=request_body(
        DatasetCreate,
        form=DatasetDescription,
        binary="An .npz or safetensors file with `keypoints` and optionally `confidence`, "
        "`points3d`, `times`, `fps`, `keypoint_names` (npz only), `edges`, `image_sizes`; others "
        "are ignored.",
    ),
)
def create_dataset(
    upload: UploadBody,
    store: StoreDep,
    settings: SettingsDep,
    request: Request,
    response: Response,
    name: Name | None = None,
    idempotency_key: IdempotencyHeader = None,
) -> Dataset:
    """Store a capture.

    `name` in the query names a capture that comes as raw bytes.
    """
    capture, description = _read_new(upload, settings, name)
    record = datasets.create(
        store,
        capture,
        description,
        idempotency=idempotency(request, idempotency_key, upload.fingerprint()),
    )
    response.headers["Location"] = f"/datasets/{record.id}"
    dataset = Dataset.of(record)
    log_findings(logger, f"Dataset {record.id}", dataset.findings)
    return dataset


@router.post(
    "/{dataset_id}/frames",
    responses=problems(*BODY_PROBLEMS, "not_found", "idempotency_key_reused"),
    openapi_extra=request_body(
        Frames,
        binary="An .npz or safetensors file with `keypoints` and optionally `confidence`, "
        "`points3d` and `times`; others are ignored.",
    ),
)
def append_frames(
    dataset_id: Identifier,
    upload: UploadBody,
    store: StoreDep,
    settings: SettingsDep,
    request: Request,
    idempotency_key: IdempotencyHeader = None,
) -> Dataset:
    """Add frames to the end of a dataset, so that a session can be streamed in chunks.

    Fits made earlier keep to the frames there were then.
    """
    record = datasets.append(
        store,
        dataset_id,
        _read_frames(upload, settings),
        max_frames=settings.max_dataset_frames,
        idempotency=idempotency(request, idempotency_key, upload.fingerprint()),
    )
    return Dataset.of(record)


@router.get("", responses=problems())
def list_datasets(
    store: StoreDep,
    asked: Annotated[Asked, Depends(asked_of("ds"))],
) -> DatasetPage:
    """List datasets, newest first."""
    return DatasetPage.read(
        store,
        records.Dataset,
        Dataset.of,
        asked,
    )


@router.get("/{dataset_id}", responses=problems("not_found"))
def get_dataset(dataset_id: Identifier, store: StoreDep) -> Dataset:
    """Describe a dataset."""
    return Dataset.of(lookup.get(store, records.Dataset, dataset_id))


add_change_route(router, records.Dataset, Dataset, Dataset.of, DatasetChange)


@router.delete(
    "/{dataset_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems("not_found", "conflict"),
)
def delete_dataset(dataset_id: Identifier, store: StoreDep) -> None:
    """Delete a dataset; models fitted to it stay."""
    datasets.delete(store, dataset_id)
