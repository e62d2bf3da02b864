"""Datasets: captures, uploaded whole or streamed in chunks."""

import logging
from datetime import UTC, datetime
from typing import Any, Self

from fastapi import APIRouter, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field

from models.findings.finding import Finding, log_findings
from service.http.dependencies import (
    IdempotencyHeader,
    Identifier,
    SettingsDep,
    StoreDep,
)
from service.http.errors import BODY_PROBLEMS, problems
from service.http.idempotency import idempotency
from service.http.operations import UNCHANGED, request_body
from service.http.preconditions import tagged
from service.http.uploads import FilesBody, UploadBody
from service.resources.changes import add_change_route
from service.resources.dataset_bodies import (
    DatasetChange,
    DatasetCreate,
    DatasetForm,
    Frames,
    ImageSize,
    read_frames,
    read_new,
)
from service.resources.lists import Page, add_list_routes, page_of
from service.wire.calibrations import CaptureCalibration
from service.wire.corrections import CorrectionsState
from service.wire.findings import EXAMPLE_FINDINGS, Findings
from service.wire.schemas import Name
from service.wire.skeletons import Skeleton
from store import dataset_changes, datasets, lookup, records, usage
from store.labels import labels_of

logger = logging.getLogger(__name__)
router = APIRouter(prefix="/datasets", tags=["datasets"])


DESCRIBED: dict[str, Any] = {
    "name": "macaque, morning session",
    "frames": 3309,
    "views": 3,
    "keypoints": 13,
    "missing_fraction": [0.61, 0.66, 0.65],
    "has_confidence": True,
    "has_ground_truth": False,
    "checksum": f"sha256:{'5e88' * 16}",
    "skeleton": None,
    "view_names": ["left", "right", "top"],
    "image_sizes": None,
    "fps": 50.0,
    "has_times": False,
    "calibration": None,
    "tags": ["pilot"],
    "metadata": {"subject": "M7"},
    "notes": ["read as DeepLabCut CSV"],
    "findings": EXAMPLE_FINDINGS,
}


class DatasetStored(BaseModel):
    """What a dataset has once it is stored."""

    id: str
    created_at: datetime
    corrections: CorrectionsState = Field(
        description="Keypoints that were corrected since: what else is here is of all frames as "
        "they were uploaded, but for `findings`."
    )


class DatasetFacts(BaseModel):
    """What is known of a capture, stored or not."""

    name: str
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
    view_names: list[str] | None
    image_sizes: list[ImageSize | None] | None
    fps: float | None = Field(description="Frames per second, null if unknown.")
    has_times: bool = Field(description="Whether every frame came with its time.")
    calibration: CaptureCalibration | None = Field(
        description="Cameras that came with the capture, for fits whose `calibration` is `dataset`."
    )
    tags: list[str]
    metadata: dict[str, Any]
    notes: list[str] = Field(
        description="What was understood and changed, if detectors' files were read."
    )
    findings: Findings

    @staticmethod
    def known(record: records.DatasetRecord) -> dict[str, Any]:
        """Return these of a record, stored or not."""
        return {
            "name": record.name,
            "frames": record.frames,
            "views": record.views,
            "keypoints": record.keypoints,
            "missing_fraction": [
                round(1 - seen / (record.frames * record.keypoints), 6) for seen in record.observed
            ],
            "has_confidence": record.confidence,
            "has_ground_truth": record.ground_truth,
            "checksum": f"sha256:{record.checksum}",
            "skeleton": Skeleton.model_validate(record.skeleton) if record.skeleton else None,
            "view_names": record.view_names,
            "image_sizes": record.image_sizes,
            "fps": record.fps,
            "has_times": record.last_times is not None,
            "calibration": record.calibration
            and CaptureCalibration.model_validate(record.calibration),
            **labels_of(record),
            "notes": record.notes or [],
            "findings": [Finding.model_validate(finding) for finding in record.findings or []],
        }


class Dataset(DatasetFacts, DatasetStored):
    """A stored capture."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "created_at": "2026-03-01T09:30:00Z",
                "corrections": {"count": 0, "checksum": None},
                **DESCRIBED,
            }
        }
    )

    @classmethod
    def of(cls, record: records.DatasetRecord) -> Self:
        """Return the wire form of a record."""
        created_at = datetime.fromtimestamp(record.created_at, UTC)
        corrected = CorrectionsState.of(record)
        return cls(id=record.id, created_at=created_at, corrections=corrected, **cls.known(record))


class DatasetPage(Page[Dataset]):
    """Datasets, newest first."""

    model_config = page_of(Dataset)


NEW_DATASET = request_body(
    DatasetCreate,
    form=DatasetForm,
    files="What a detector wrote, one file for each camera: CSV, H5, JSON of the formats of "
    "docs/files.md; a zip file for a folder of JSON files; a calibration file.",
    folders="In place of `files` a zip of files and folders, one for each camera or with those of "
    "all in it, which are read as if they were listed one by one.",
    binary="An .npz or safetensors file with `keypoints` and optionally `confidence`, "
    "`points3d`, `times`, `fps`, `keypoint_names` (npz only), `edges`, `image_sizes`; others "
    "are ignored.",
)


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(*BODY_PROBLEMS, "idempotency_key_reused"),
    openapi_extra=NEW_DATASET,
)
def create_dataset(
    upload: FilesBody,
    store: StoreDep,
    settings: SettingsDep,
    request: Request,
    response: Response,
    name: Name | None = None,
    idempotency_key: IdempotencyHeader = None,
) -> Dataset:
    """Store a capture.

    `name` in the query names a capture that is sent as raw bytes. Files of detectors are sent in a
    form, as `files`, one for each camera, and folders in a zip, as `folders`; `notes` of the answer
    report how they were read.
    """
    capture, description, _ = read_new(upload, settings, name, may_keep=usage.left(store))
    record = datasets.create(
        store,
        capture,
        description,
        idempotency=idempotency(request, idempotency_key, upload),
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
        read_frames(upload, settings),
        max_frames=settings.max_dataset_frames,
        idempotency=idempotency(request, idempotency_key, upload),
    )
    return Dataset.of(record)


add_list_routes(
    router, records.DatasetRecord, DatasetPage, Dataset.of, prefix="ds", delete=datasets.delete
)


@router.get(
    "/{dataset_id}",
    response_model=Dataset,
    responses=problems("not_found") | UNCHANGED,
)
def get_dataset(
    dataset_id: Identifier, store: StoreDep, request: Request, response: Response
) -> Any:
    """Describe a dataset."""
    return tagged(
        request, response, lookup.get(store, records.DatasetRecord, dataset_id), Dataset.of
    )


add_change_route(
    router,
    records.DatasetRecord,
    Dataset,
    Dataset.of,
    change=DatasetChange,
    write=dataset_changes.change,
)


@router.delete(
    "/{dataset_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems("not_found", "conflict"),
)
def delete_dataset(dataset_id: Identifier, store: StoreDep) -> None:
    """Delete a dataset; models fitted to it stay."""
    datasets.delete(store, dataset_id)
