"""Models: fitted priors, to read, download, import and delete."""

import subprocess
from collections.abc import AsyncIterator
from datetime import datetime
from typing import Any, Self

from fastapi import APIRouter, Depends, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field

from models.findings.finding import dumped
from models.lifting.fitted_prior import FittedPrior
from models.lifting.trial_lift import try_to_lift
from models.numerics.tensor_files import WeightsError
from models.settings.config import FitConfig
from service.http.dependencies import (
    IdempotencyHeader,
    Identifier,
    StoreDep,
)
from service.http.downloads import bytes_response
from service.http.errors import BODY_PROBLEMS, ApiError, problems
from service.http.idempotency import idempotency
from service.http.negotiation import OCTETS
from service.http.operations import UNCHANGED, file_responses, request_body
from service.http.preconditions import tagged
from service.http.uploads import UploadBody
from service.realtime.dependencies import EngineDep
from service.resources.changes import add_change_route
from service.resources.lists import Page, add_list_routes, page_of
from service.wire.findings import EXAMPLE_FINDINGS, Findings
from service.wire.model_files import ModelDescription, described, taken_apart
from service.wire.schemas import Name
from service.wire.skeletons import Skeleton
from store import aliases, lookup, models, records
from store.labels import Labels, labels_of
from worker.process import python, tied

router = APIRouter(prefix="/models", tags=["models"])

NETWORK_SECONDS = 300  # a few are enough where nothing else runs


class CurvePoint(BaseModel):
    """One row of a training curve."""

    step: int
    loss: float | None
    reprojection_error: float | None = Field(description="Pixels.")


_EXAMPLE: dict[str, Any] = {
    "id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
    "name": "macaque",
    "created_at": "2026-03-01T09:32:00Z",
    "fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
    "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
    "frames": 3309,
    "views": 3,
    "keypoints": 13,
    "config": FitConfig().model_dump(mode="json"),
    "skeleton": None,
    "tags": ["pilot"],
    "metadata": {"subject": "M7"},
    "reprojection_error": 3.1,
    "frames_lifted": 3300,
    "pa_mpjpe": 0.061,
    "pck": 0.86,
    "pck_threshold": 0.1,
    "weights_bytes": 91234,
    "weights_checksum": f"sha256:{'5e88' * 16}",
    "version": "0.1.0",
    "findings": EXAMPLE_FINDINGS,
}


class ModelSummary(BaseModel):
    """A fitted prior, as lists show it."""

    model_config = ConfigDict(json_schema_extra={"example": _EXAMPLE})

    id: str
    name: str
    created_at: datetime
    fit_id: str | None = Field(description="The fit that made it; null if it was imported.")
    dataset_id: str | None
    frames: int | None = Field(
        description="Frames it was fitted to; null if it was imported from a file without them."
    )
    views: int | None = Field(
        description="Views it was fitted to, null as `frames`; it lifts any number of them."
    )
    keypoints: int = Field(description="Keypoints per view.")
    config: FitConfig
    skeleton: Skeleton | None
    tags: list[str]
    metadata: dict[str, Any]
    reprojection_error: float | None = Field(
        None, description="Pixels, mean over the views of the fitted frames."
    )
    frames_lifted: int | None = Field(None, description="Fitted frames that got a structure.")
    pa_mpjpe: float | None = Field(
        None,
        description="Mean Procrustes-aligned error of the fitted frames against the ground truth, "
        "in its unit; null without one.",
    )
    pck: float | None = Field(
        None, description="Share of keypoints closer to the truth than `pck_threshold`."
    )
    pck_threshold: float | None = None
    weights_bytes: int = Field(description="Without the description that an export adds.")
    weights_checksum: str = Field(description="Of these bytes; a copy elsewhere has the same.")
    version: str | None = Field(
        description="Version of Fewview whose fit made it; null if an older one did."
    )
    findings: Findings

    @classmethod
    def of(cls, record: records.ModelRecord) -> Self:
        """Return the wire form of a record."""
        return cls.model_validate(cls._fields_of(record))

    @classmethod
    def _fields_of(cls, record: records.ModelRecord) -> dict[str, Any]:
        return {
            "id": record.id,
            "name": record.name,
            "created_at": record.created_at,
            "fit_id": record.fit_id,
            "dataset_id": record.dataset_id,
            "frames": record.frames,
            "views": record.views,
            "keypoints": record.keypoints,
            "config": record.config,
            "skeleton": record.skeleton,
            "weights_bytes": record.weights_bytes,
            "weights_checksum": f"sha256:{record.weights_checksum}",
            "version": record.version,
            "findings": record.findings or [],
            **labels_of(record),
            **record.metrics,
        }


class Model(ModelSummary):
    """A fitted prior."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": _EXAMPLE
            | {"training_curve": [{"step": 20, "loss": 0.4, "reprojection_error": 60.1}]}
        }
    )

    training_curve: list[CurvePoint]

    @classmethod
    def _fields_of(cls, record: records.ModelRecord) -> dict[str, Any]:
        return {**super()._fields_of(record), "training_curve": record.training_curve}


class ModelPage(Page[ModelSummary]):
    """Models, newest first, without their training curves."""

    model_config = page_of(ModelSummary)


class ModelImport(Labels):
    """Labels of imported weights, which replace those in the file."""

    name: Name = "imported"
    skeleton: Skeleton | None = None


add_list_routes(
    router, records.ModelRecord, ModelPage, ModelSummary.of, prefix="mdl", delete=models.delete
)


@router.get("/{model_id}", response_model=Model, responses=problems("not_found") | UNCHANGED)
def get_model(model_id: Identifier, store: StoreDep, request: Request, response: Response) -> Any:
    """Describe a model: configuration, training curve, errors."""
    return tagged(request, response, lookup.get(store, records.ModelRecord, model_id), Model.of)


@router.get(
    "/{model_id}/weights",
    response_class=Response,
    responses=problems("not_found", "range_not_satisfiable")
    | file_responses("The weights as safetensors, to be imported elsewhere.", OCTETS),
)
def download_weights(model_id: Identifier, store: StoreDep, request: Request) -> Response:
    """Download a model (safetensors), whole or a range of its bytes.

    The file has the weights with configuration, training curve, cameras and findings. Its header
    has name, skeleton, views, frames and figures, so that `POST /models` makes the same model.
    """
    record = lookup.get(store, records.ModelRecord, model_id)
    return bytes_response(
        request,
        described(models.load_weights(store, record), ModelDescription.of(record)),
        media_type=OCTETS,
        filename=f"{record.id}.safetensors",
    )


async def take_turn(request: Request) -> AsyncIterator[None]:
    """Have a few networks made at a time, so that threads are left for others."""
    async with request.app.state.calculations.turn(request):
        yield


@router.get(
    "/{model_id}/network",
    dependencies=[Depends(take_turn, scope="function")],
    response_class=Response,
    responses=problems("not_found", "conflict", "range_not_satisfiable")
    | file_responses("The network as an ONNX file.", OCTETS),
)
def download_network(
    model_id: Identifier, store: StoreDep, engine: EngineDep, request: Request
) -> Response:
    """Download a model's feed-forward network as ONNX, which takes seconds to make.

    From `keypoints` (N, K, P, 2) in pixels, NaN where not observed, and `confidence` (N, K, P) it
    computes `points3d` (N, P, 3), `rotations` (N, K, 3, 3), `scales` (N, K) and `translations`
    (N, K, 2) in pixels, NaN where there is no answer: what `POST /lift` answers with `refine: off`.
    Perspective is not in it. A model that removes noise before its network has none (409).
    """
    model = engine.models.get(store.project, model_id)
    if model.prior.denoises:
        raise ApiError(
            "conflict",
            f"Model {model.id!r} removes noise from its keypoints before the network, which ONNX "
            "has no part for: fit with `denoising: false`.",
        )
    weights = models.load_weights(store, lookup.get(store, records.ModelRecord, model.id))
    made = subprocess.run(  # noqa: S603 (our own program)
        tied(*python("-m", "models.lifting.onnx_file")),
        input=weights,
        stdout=subprocess.PIPE,
        timeout=NETWORK_SECONDS,
        check=True,
    )
    return bytes_response(request, made.stdout, media_type=OCTETS, filename=f"{model.id}.onnx")


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(*BODY_PROBLEMS, "idempotency_key_reused"),
    openapi_extra=request_body(
        form=ModelImport, binary="Weights as `GET /models/{id}/weights` gives them."
    ),
)
def import_model(
    upload: UploadBody,
    store: StoreDep,
    request: Request,
    response: Response,
    name: Name | None = None,
    idempotency_key: IdempotencyHeader = None,
) -> Model:
    """Import a model that was downloaded from this or another Fewview.

    It is the same model, but for its identifiers; `name` in the query, or in the form, renames it.
    """
    if upload.is_json:
        raise ApiError(
            "unsupported_media_type",
            "expected the weights' bytes (application/octet-stream) or a form, got JSON",
        )
    given = upload.form(ModelImport, {} if name is None else {"name": name})
    try:
        weights, known = taken_apart(upload.data)
        prior = FittedPrior.from_bytes(weights)
        try_to_lift(prior)
    except WeightsError as error:
        raise ApiError("malformed_body", f"These are no weights of a model: {error}") from error
    views = prior.capture.views or prior.known_views
    if views and known.views not in (None, views):
        raise ApiError(
            "malformed_body",
            f"These are no weights of a model: they are of {views} views, and the file's header "
            f"has {known.views}.",
        )
    known = known.model_copy(
        update={field: getattr(given, field) for field in given.model_fields_set}
    )
    if known.skeleton is not None:
        known.skeleton.check(prior.keypoints_per_frame)
    columns: dict[str, Any] = {
        "name": known.name or given.name,
        "views": known.views,
        "frames": known.frames,
        "keypoints": prior.keypoints_per_frame,
        "config": prior.config.model_dump(mode="json"),
        "skeleton": known.skeleton and known.skeleton.model_dump(),
        "version": known.version,
        "training_curve": [point._asdict() for point in prior.curve],
        "metrics": known.metrics.model_dump(),
        "findings": dumped(prior.findings),
        **known.columns(),
    }
    record = models.create(
        store,
        weights,
        idempotency=idempotency(request, idempotency_key, upload),
        **columns,
    )
    response.headers["Location"] = f"/models/{record.id}"
    return Model.of(record)


add_change_route(router, records.ModelRecord, Model, Model.of)


@router.delete(
    "/{model_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems("not_found", "conflict"),
)
def delete_model(model_id: Identifier, store: StoreDep, engine: EngineDep) -> None:
    """Delete a model and its weights; the fit that made it keeps its reconstruction.

    Lifts of datasets that are not done yet need it, and so do fits that start from it: cancel them
    first. Move or delete its aliases, too. Of an alias (`DELETE /models/walk@production`) the alias
    alone is deleted.
    """
    if lookup.is_alias(model_id):
        aliases.delete(store, model_id)
        engine.models.look()
        return
    models.delete(store, model_id)
    engine.models.forget(model_id)
