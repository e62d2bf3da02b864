"""Cameras: those that a fit estimated, of the fit and of its model."""

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from service.http.dependencies import Identifier, StoreDep
from service.http.downloads import bytes_response
from service.http.errors import ApiError, problems
from service.http.operations import file_responses
from service.realtime.dependencies import EngineDep
from service.resources.fits import FitDep
from service.resources.reconstructions import answering
from service.wire.calibrations import MEDIA_TYPES, CalibrationFormat, calibration_file
from service.wire.cameras import FitCameras, ModelCameras
from store import lookup, records
from store.answers import answer_stage
from store.database import Store
from store.errors import NotFoundError

router = APIRouter()

FormatQuery = Annotated[
    CalibrationFormat,
    Query(
        description="`json`, or the calibration file of another tool: `anipose` (TOML), "
        "`opencv` (YAML) or `colmap` (its text files in a zip). Cameras that move have no "
        "pose there. They are called as the dataset's views. Anipose and COLMAP need its image "
        "sizes."
    ),
]
FILES = file_responses("The cameras, as JSON or as a calibration file.", *MEDIA_TYPES)


@router.get(
    "/models/{model_id}/cameras",
    tags=["models"],
    response_model=ModelCameras,
    responses=problems("not_found", "conflict", "range_not_satisfiable") | FILES,
)
def get_model_cameras(
    model_id: Identifier,
    request: Request,
    engine: EngineDep,
    store: StoreDep,
    format: FormatQuery = "json",
) -> Response | ModelCameras:
    """Return the cameras that the fit estimated, with standard deviations and reasons.

    A model that was fitted without refinement has the arrangement `unknown`.
    """
    model = engine.models.read(store.project, model_id)
    cameras = ModelCameras.of(model.id, model.prior.cameras, model.best_frame)
    if format == "json":
        return cameras
    dataset_id = lookup.get(store, records.ModelRecord, model.id).dataset_id
    return _as_file(cameras, request, store, dataset_id, format, model.id)


@router.get(
    "/fits/{fit_id}/cameras",
    tags=["fits"],
    response_model=FitCameras,
    responses=problems("not_found", "conflict", "range_not_satisfiable") | FILES,
)
def get_fit_cameras(
    fit: FitDep,
    request: Request,
    engine: EngineDep,
    store: StoreDep,
    format: FormatQuery = "json",
) -> Response | FitCameras:
    """Return the cameras that the fit has estimated by now.

    Where geometry finds static cameras, they are there before the network is taught.
    """
    model, stage = answering(fit, store, engine), answer_stage(fit) or "network"
    cameras = FitCameras.of(fit, stage, model.prior.cameras, model.best_frame)
    if format == "json":
        return cameras
    return _as_file(cameras, request, store, fit.dataset_id, format, fit.id)


def _as_file(
    cameras: ModelCameras | FitCameras,
    request: Request,
    store: Store,
    dataset_id: str | None,
    format: CalibrationFormat,
    name: str,
) -> Response:
    try:
        file = calibration_file(cameras, format, *_names_and_sizes(store, dataset_id))
    except ValueError as error:
        raise ApiError("conflict", f"{error}; format=json has everything that is known") from error
    return bytes_response(
        request, file.content, media_type=file.media_type, filename=f"{name}-{file.filename}"
    )


def _names_and_sizes(
    store: Store, dataset_id: str | None
) -> tuple[list[str] | None, list[tuple[int, int] | None] | None]:
    """Return names and (width, height) of the views, None if no dataset has them."""
    if dataset_id is None:
        return None, None
    try:
        dataset = lookup.get(store, records.DatasetRecord, dataset_id)
    except NotFoundError:
        return None, None
    sizes = [None if size is None else (size[0], size[1]) for size in dataset.image_sizes or ()]
    return dataset.view_names or None, sizes or None
