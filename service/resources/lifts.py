"""Big lifts: jobs that lift a stored dataset of any length."""

import json
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Self

from fastapi import APIRouter, Depends, Query, Request, Response, status
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field
from redis import Redis

from models.settings.config import Refine
from models.settings.rooms import FrameOfReference, Up
from models.settings.uncertainty import Uncertainty
from service.http.dependencies import (
    IdempotencyHeader,
    RedisDep,
    SettingsDep,
    StoreDep,
)
from service.http.downloads import ranged_response
from service.http.errors import BODY_PROBLEMS, problems
from service.http.idempotency import idempotency
from service.http.negotiation import BINARY_FORMATS, NPZ, OCTETS, accepted_format
from service.http.operations import file_responses, request_body
from service.http.uploads import UploadBody
from service.realtime.dependencies import EngineDep, RoomsDep
from service.realtime.frames import check_views
from service.realtime.rooms import check_known
from service.resources.jobs import (
    JobStatus,
    Words,
    add_job_routes,
    announce,
    finder,
    job_columns,
)
from service.resources.lists import Columns, Page, add_list_routes, page_of
from service.wire.corrections import CorrectionsState
from service.wire.findings import Findings
from service.wire.json_bodies import read_json
from service.wire.requests import LiftCreate
from service.wire.rooms import FRAME_OF_REFERENCE, UP, is_room
from service.wire.schemas import UNCERTAINTY
from store import lifts, lookup, records
from store.database import Store
from store.errors import ConflictError
from store.labels import Labels, labels_of
from store.lift_files import ResultFormat, result_file

router = APIRouter(prefix="/lifts", tags=["lifts"])

JSON_LINES = "application/x-ndjson"
FORMATS: dict[str, ResultFormat] = {
    "*/*": "jsonl",
    "application/*": "jsonl",
    JSON_LINES: "jsonl",
    "application/jsonl": "jsonl",
    **BINARY_FORMATS,
}
MEDIA_TYPES: dict[ResultFormat, str] = {"jsonl": JSON_LINES, "npz": NPZ, "safetensors": OCTETS}


class LiftProgress(BaseModel):
    """How far a lift has come."""

    frames_done: int
    chunks_done: int
    chunks: int = Field(description="Parts that the frames are cut into, for workers to share.")
    seconds_left: float | None = Field(description="At the pace of the last chunks.")


class LiftFailure(BaseModel):
    """Why a lift failed."""

    code: str = Field(
        description="`dataset_not_found`, `model_not_found`, `object_damaged`, "
        "`invalid_arguments`, `worker_lost` or `internal_error`."
    )
    message: str


class LiftJob(BaseModel):
    """The lift of a dataset."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "lift_01m7ysr6k3w9m0x2c4a8h5e7dq",
                "name": "macaque, the whole day",
                "status": "running",
                "model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "frames": 1000000,
                "corrections": {"count": 0, "checksum": None},
                "refine": "auto",
                "views": None,
                "frame": "canonical",
                "up": None,
                "uncertainty": "sd",
                "tags": ["pilot"],
                "metadata": {"subject": "M7"},
                "job_id": "lift_01m7ysr6k3w9m0x2c4a8h5e7dq",
                "progress": {
                    "frames_done": 407600,
                    "chunks_done": 100,
                    "chunks": 245,
                    "seconds_left": 310.5,
                },
                "created_at": "2026-03-01T09:41:00Z",
                "started_at": "2026-03-01T09:41:01Z",
                "finished_at": None,
                "error": None,
                "findings": [],
            }
        }
    )

    id: str
    name: str
    status: JobStatus
    model_id: str
    dataset_id: str
    frames: int = Field(description="Frames the dataset had when the lift was made: those lifted.")
    corrections: CorrectionsState = Field(
        description="Of the dataset when this was made: it sees no others."
    )
    refine: Refine | None
    views: list[int] | None
    frame: FrameOfReference = Field(description=FRAME_OF_REFERENCE)
    up: Up | None = Field(description=UP)
    uncertainty: Uncertainty = Field(description=UNCERTAINTY)
    tags: list[str]
    metadata: dict[str, Any]
    job_id: str = Field(description="The job that asked for this lift on the queue.")
    progress: LiftProgress
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error: LiftFailure | None
    findings: Findings

    @classmethod
    def of(cls, record: records.LiftRecord) -> Self:
        """Return the wire form of a record."""
        labels = labels_of(record)
        plain = cls.model_fields.keys() - labels.keys() - {"progress", "corrections"}
        shared = {name: getattr(record, name) for name in plain}
        shared["findings"] = record.findings or []
        shared["frame"] = record.frame or "canonical"  # of older versions
        shared["uncertainty"] = record.uncertainty or "sd"
        progress = {name: getattr(record, name) for name in LiftProgress.model_fields}
        corrected = CorrectionsState.of(record)
        return cls.model_validate(
            {**shared, **labels, "progress": progress, "corrections": corrected}
        )


class LiftPage(Page[LiftJob]):
    """Lifts, newest first."""

    model_config = page_of(LiftJob)


LiftDep = Annotated[records.LiftRecord, Depends(finder(records.LiftRecord))]


@router.post(
    "",
    status_code=status.HTTP_202_ACCEPTED,
    responses=problems(
        *BODY_PROBLEMS, "not_found", "conflict", "idempotency_key_reused", "too_many_lifts"
    ),
    openapi_extra=request_body(LiftCreate),
)
def create_lift(
    upload: UploadBody,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    redis: RedisDep,
    settings: SettingsDep,
    request: Request,
    response: Response,
    idempotency_key: IdempotencyHeader = None,
) -> LiftJob:
    """Queue the lift of a stored dataset of any length.

    All workers that have nothing else to do share it, chunk by chunk. What is done stays done
    whatever happens to them. `POST /lift` answers at once, and is for as many frames as fit into
    a request.
    """
    body = read_json(upload, LiftCreate)
    in_room = is_room(body.frame, body.up)
    if body.views is not None or in_room:
        dataset = lookup.get(store, records.DatasetRecord, body.dataset_id)
        model = engine.models.get(store.project, body.model_id)
        if body.views is not None:
            check_views(body.views, model.prior, dataset.views)
        if in_room:
            check_known(rooms.find(model, body.up), body.views, dataset.views)
    record = lifts.create(
        store,
        **body.model_dump(exclude=set(Labels.model_fields)),
        labels=body,
        chunk_frames=settings.lift_chunk_frames,
        max_queued=settings.max_queued_lifts,
        idempotency=idempotency(request, idempotency_key, upload),
    )
    announce(record, store, redis, response)
    return LiftJob.of(record)


async def _columns(
    shared: Annotated[Columns, Depends(job_columns)],
    store: StoreDep,
    model_id: Annotated[str | None, Query(max_length=200)] = None,
) -> Columns:
    if model_id is not None and lookup.is_alias(model_id):
        model_id = (await run_in_threadpool(lookup.get, store, records.ModelRecord, model_id)).id
    return shared | {"model_id": model_id}


add_list_routes(
    router,
    records.LiftRecord,
    LiftPage,
    LiftJob.of,
    prefix="lift",
    delete=lifts.delete,
    columns=_columns,
    codes=("not_found",),  # an alias of a model that there is not
)


def _cancel(store: Store, _redis: Redis, lift_id: str) -> records.LiftRecord:
    return lifts.cancel(store, lift_id)


add_job_routes(
    router,
    records.LiftRecord,
    LiftJob,
    LiftJob.of,
    cancel=_cancel,
    delete=lifts.delete,
    words=Words(
        delete="Delete a lift that has ended, and its result.",
        cancel="Cancel a lift at once; its workers leave it within two seconds, and nothing of it "
        "stays.",
        progress="as chunks get done",
    ),
)


@router.get(
    "/{lift_id}/result",
    response_class=Response,
    responses=problems("not_found", "conflict", "not_acceptable", "range_not_satisfiable")
    | file_responses(
        "Every frame of the dataset, lifted: JSON lines (`application/x-ndjson`) unless another "
        "form is asked for, safetensors (`application/octet-stream`) or npz (`application/x-npz`).",
        *MEDIA_TYPES.values(),
    ),
)
def get_lift_result(
    lift: LiftDep,
    store: StoreDep,
    request: Request,
    format: Annotated[
        ResultFormat | None,
        Query(description="Representation; without it the `Accept` header decides."),
    ] = None,
) -> Response:
    """Download the lifted frames in the dataset's order, whole or a range of the bytes.

    As JSON lines, one frame a line as `POST /lift` gives it in `frames`; or as the arrays that
    `GET /fits/{fit_id}/reconstruction` describes, in a safetensors or an npz file.
    """
    chosen = accepted_format(request, format, FORMATS)
    if lift.status != "succeeded":
        raise ConflictError(
            f"Lift {lift.id!r} is {lift.status}: only a lift that succeeded has a result."
        )
    about = {"lift_id": lift.id, "model_id": lift.model_id, "dataset_id": lift.dataset_id}
    if lift.findings:
        about["findings"] = json.dumps(lift.findings)
    file = result_file(lift, lifts.finished_chunks(store, lift), chosen, about)
    return ranged_response(
        request,
        file.size,
        partial(file.read, lookup.reader_of(store, records.LiftRecord, lift.id)),
        media_type=MEDIA_TYPES[chosen],
        filename=f"{lift.id}.{chosen}",
        checksum=file.checksum(),
    )
