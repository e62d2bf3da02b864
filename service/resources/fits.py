"""Fits: jobs that turn a dataset into a model."""

from contextlib import suppress
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, Self

from fastapi import APIRouter, Depends, Query, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field
from redis import Redis
from redis.exceptions import RedisError
from typing_extensions import TypeAliasType

from models.findings.finding import Finding
from models.findings.verdict import Verdict, verdict_of
from models.settings.config import FitConfig
from service.http.dependencies import (
    IdempotencyHeader,
    RedisDep,
    SettingsDep,
    StoreDep,
)
from service.http.errors import BODY_PROBLEMS, ApiError, invalid, problems
from service.http.idempotency import idempotency
from service.http.operations import request_body
from service.http.uploads import UploadBody
from service.resources.changes import Change
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
from service.wire.schemas import Name
from service.wire.stages import STAGES, AnswerStage
from store import fits, lookup, records
from store.answers import answer_stage
from store.database import Store
from store.jobs import TERMINAL, Priority
from store.labels import Labels, Text, labels_of
from worker.queue import open_queues

router = APIRouter(prefix="/fits", tags=["fits"])

FitStage = TypeAliasType("FitStage", Literal["training", "refining"])
StoppedBy = TypeAliasType("StoppedBy", Literal["steps", "budget", "early"])
FitPriority = TypeAliasType("FitPriority", Priority)
PRIORITIES = (
    "Among the fits of a project that wait: `high` ones start first, `low` ones last. Each day of "
    "waiting counts as the next priority. Projects take turns whatever theirs are."
)


class FitCreate(Labels):
    """A fit to make."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "name": "macaque",
                "tags": ["pilot"],
                "config": {
                    "seed": 1,
                    "cameras": "static",
                    "known_length": {"keypoints": [2, 3], "length": 0.26},
                },
            }
        },
    )

    dataset_id: Text = Field(max_length=200)
    name: Name = "fit"
    from_model: Text | None = Field(
        None,
        max_length=200,
        description="A model of the same keypoints whose weights the fit starts from, for example "
        "of the same subject or species. The fit has its `dictionary_sizes`, and 1100 `steps` "
        "unless these are given.",
    )
    priority: FitPriority = Field("normal", description=PRIORITIES)
    calibration: Literal["dataset"] | None = Field(
        None,
        description="`dataset`: `calibration` of `config` is that which came with the dataset.",
    )
    config: FitConfig = FitConfig()


class FitProgress(BaseModel):
    """How far a fit has come."""

    stage: FitStage = Field(
        "training",
        description="`training` while steps of the network are taken. `refining` while the cameras "
        "are sought and frames are refined for the network to learn from; then training goes on.",
    )
    step: int
    steps: int
    loss: float | None = Field(description="Running mean over recent batches.")
    reprojection_error: float | None = Field(
        description="Pixels, running mean over recent batches."
    )
    seconds_left: float | None = Field(
        description="An estimate at the pace of the last steps; it can rise when the stage "
        "changes. Null while there is no pace: before and during the first steps."
    )
    stopped_by: StoppedBy | None = Field(
        None,
        description="What ended the training: all its steps were taken, `budget_s` ran out, or "
        "`early_stopping` saw nothing more to learn. Null while it goes on.",
    )


class FitError(BaseModel):
    """Why a fit failed."""

    code: str = Field(
        description="`dataset_not_found`, `model_not_found`, `unusable_capture`, "
        "`object_damaged`, `invalid_arguments`, `timed_out`, `worker_lost` or `internal_error`."
    )
    message: str


class Fit(BaseModel):
    """A fit job."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
                "name": "macaque",
                "status": "running",
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "frames": 3309,
                "corrections": {"count": 0, "checksum": None},
                "from_model": None,
                "priority": "normal",
                "config": FitConfig().model_dump(mode="json"),
                "tags": ["pilot"],
                "metadata": {"subject": "M7"},
                "job_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
                "attempt": 1,
                "cancel_requested": False,
                "progress": {
                    "stage": "training",
                    "step": 1200,
                    "steps": 4000,
                    "loss": 0.031,
                    "reprojection_error": 3.4,
                    "seconds_left": 14.2,
                    "stopped_by": None,
                },
                "created_at": "2026-03-01T09:31:00Z",
                "started_at": "2026-03-01T09:31:01Z",
                "finished_at": None,
                "answer_stage": "geometry",
                "model_id": None,
                "version": None,
                "error": None,
                "findings": [],
                "verdict": None,
            }
        }
    )

    id: str
    name: str
    status: JobStatus
    dataset_id: str
    frames: int = Field(description="Frames the dataset had when the fit was made: those it sees.")
    corrections: CorrectionsState = Field(
        description="Of the dataset when this was made: it sees no others."
    )
    from_model: str | None = Field(description="The model whose weights it started with.")
    priority: FitPriority = Field(description=PRIORITIES)
    config: FitConfig | None = Field(
        description="With defaults filled in; null if the job that asked for the fit had none that "
        "is valid."
    )
    tags: list[str]
    metadata: dict[str, Any]
    job_id: str = Field(description="The job that carries this fit on the queue.")
    attempt: int = Field(description="How often it was started; more than once after a crash.")
    cancel_requested: bool
    progress: FitProgress | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    answer_stage: AnswerStage | None = Field(
        None, description=f"Of its reconstruction; null while there is none. {STAGES}"
    )
    model_id: str | None
    version: str | None = Field(
        description="Version of Fewview that made or ended it; null while it goes on, and if an "
        "older one did."
    )
    error: FitError | None
    findings: Findings
    verdict: Verdict | None = Field(
        None, description="What may be relied on; null until it has succeeded."
    )

    @classmethod
    def of(cls, record: records.FitRecord) -> Self:
        """Return the wire form of a record."""
        found = [Finding.model_validate(each) for each in record.findings or []]
        return cls.model_validate(
            {
                "id": record.id,
                "name": record.name,
                "status": record.status,
                "dataset_id": record.dataset_id,
                "frames": record.frames,
                "corrections": CorrectionsState.of(record),
                "from_model": record.from_model,
                "priority": record.priority,
                "config": record.config or None,
                "job_id": record.job_id,
                "attempt": record.attempt,
                "cancel_requested": record.cancel_requested_at is not None,
                "progress": record.progress,
                "created_at": record.created_at,
                "started_at": record.started_at,
                "finished_at": record.finished_at,
                "answer_stage": answer_stage(record),
                "model_id": record.model_id,
                "version": record.version,
                "error": record.error,
                "findings": found,
                "verdict": verdict_of(found, record.report_words)
                if record.status == "succeeded"
                else None,
                **labels_of(record),
            }
        )


class FitChange(Change):
    """What to change of a fit; what is left out, or null, stays as it is."""

    emptied: ClassVar = ""
    codes: ClassVar = ("conflict",)

    priority: FitPriority | None = Field(None, description=PRIORITIES)

    def columns(self) -> dict[str, Any]:
        """Return the record's columns that change, with their new values."""
        more = {} if self.priority is None else {"priority": self.priority}
        return super().columns() | more

    def check(self, record: Any) -> None:
        """Raise ``ApiError`` if a fit that has ended is to be more or less urgent."""
        if self.priority is not None and record.status in TERMINAL:
            raise ApiError(
                "conflict",
                f"Fit {record.id!r} has ended ({record.status}): leave its priority out.",
            )


class FitPage(Page[Fit]):
    """Fits, newest first."""

    model_config = page_of(Fit)


FitDep = Annotated[records.FitRecord, Depends(finder(records.FitRecord))]


@router.post(
    "",
    status_code=status.HTTP_202_ACCEPTED,
    responses=problems(*BODY_PROBLEMS, "not_found", "idempotency_key_reused", "too_many_fits"),
    openapi_extra=request_body(FitCreate),
)
def create_fit(
    upload: UploadBody,
    store: StoreDep,
    redis: RedisDep,
    settings: SettingsDep,
    request: Request,
    response: Response,
    idempotency_key: IdempotencyHeader = None,
) -> Fit:
    """Queue a fit of a dataset.

    The fit is recorded before it is queued: if the queue is away, it is queued as soon as a worker
    and the queue are back.
    """
    body = read_json(upload, FitCreate)
    config = body.config.model_dump(mode="json", exclude_unset=True)
    if body.calibration is not None:
        config["calibration"] = _calibration_of(store, body)
    record = fits.create(
        store,
        dataset_id=body.dataset_id,
        name=body.name,
        config=config,
        from_model=body.from_model,
        priority=body.priority,
        labels=body,
        max_queued=settings.max_queued_fits,
        idempotency=idempotency(request, idempotency_key, upload),
    )
    announce(record, store, redis, response)
    return Fit.of(record)


async def fit_columns(
    columns: Annotated[Columns, Depends(job_columns)],
    from_model: Annotated[
        Text | None,
        Query(max_length=200, description="Those that start with this model's weights."),
    ] = None,
) -> Columns:
    """Return what columns of the fits in a list must hold."""
    return {**columns, "from_model": from_model}


def _calibration_of(store: Store, body: FitCreate) -> list[Any]:
    """Return the cameras that came with a fit's dataset."""
    if body.config.calibration is not None:
        raise invalid("/calibration", "expected this or config.calibration, got both: leave one")
    known = lookup.get(store, records.DatasetRecord, body.dataset_id).calibration
    if known is None:
        raise invalid(
            "/calibration",
            "the dataset came without a calibration: give the cameras as config.calibration",
        )
    cameras: list[Any] = known["cameras"]
    return cameras


add_list_routes(
    router,
    records.FitRecord,
    FitPage,
    Fit.of,
    prefix="fit",
    delete=fits.delete,
    columns=fit_columns,
)


def _cancel(store: Store, redis: Redis, fit_id: str) -> records.FitRecord:
    record = fits.cancel(store, fit_id)
    if record.status == "cancelled":
        # Best effort: a cancelled fit cannot be claimed, its job would end at once.
        with suppress(RedisError):
            for queue in open_queues(redis):
                queue.remove(record.job_id)
    return record


add_job_routes(
    router,
    records.FitRecord,
    Fit,
    Fit.of,
    cancel=_cancel,
    delete=fits.delete,
    words=Words(
        delete="Delete a fit that has ended, its reconstruction and its report; its model stays.",
        cancel="Cancel a queued fit at once, a running one within two seconds.",
        progress="while it goes on",
    ),
    change=FitChange,
)
