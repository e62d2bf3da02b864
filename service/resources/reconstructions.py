"""Reconstructions: every frame of a fitted dataset, lifted."""

import hashlib
from collections.abc import AsyncIterator, Iterator
from functools import partial
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from models.lifting.film import film_of
from models.settings.config import Refine
from models.settings.rooms import Up
from models.settings.uncertainty import Uncertainty, of_uncertainty
from service.http.dependencies import SettingsDep, StoreDep
from service.http.downloads import ranged_response, streamed_response
from service.http.errors import invalid, problems
from service.http.negotiation import NPZ, OCTETS
from service.http.operations import file_responses
from service.realtime.dependencies import EngineDep, RoomsDep
from service.realtime.engine import Engine
from service.realtime.lift import RefineQuery, UncertaintyQuery, answer_bytes
from service.realtime.rooms import Rooms
from service.realtime.warm_models import WarmModel
from service.resources.fits import FitDep
from service.wire.arrays import Arrays
from service.wire.findings import FindingForm, Findings
from service.wire.representations import (
    JSON,
    FormatQuery,
    arrays_response,
    chosen_format,
    json_pieces,
    metadata_of,
)
from service.wire.rooms import FrameQuery, UpQuery, is_room, read_up
from service.wire.schemas import LIFTED_FRAME, LiftedFrame
from service.wire.stages import STAGES, AnswerStage
from store import answers, datasets, fits, lookup, records
from store.answers import answer_stage, reconstruction_key
from store.array_files import safetensors_arrays
from store.database import Store
from store.errors import ConflictError
from store.reconstruction_files import reconstruction_file, reconstruction_parts
from worker.rooms import Room

router = APIRouter(prefix="/fits", tags=["fits"])

FEW_FRAMES = 1000  # that wait for no turn
FramesQuery = Annotated[
    str | None,
    Query(
        alias="frames",
        pattern=r"^[0-9]{0,9}:[0-9]{0,9}(:[1-9][0-9]{0,8})?$",
        description="Of what the fit stored, only some frames, as slices of Python name them: "
        "`100:200` are a hundred, `::20` every twentieth. They are answered like a fit that has no "
        "others.",
    ),
]


class Reconstruction(BaseModel):
    """Every frame of the fitted dataset, lifted by the fit's own model."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
                "model_id": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "dataset_id": "ds_01m7yspdypmt22jq6npfg62xe5",
                "stage": "network",
                "frames": [LIFTED_FRAME],
                "findings": [],
            }
        }
    )

    fit_id: str
    model_id: str | None
    dataset_id: str
    stage: AnswerStage = Field(description=STAGES)
    frames: list[LiftedFrame]
    findings: Findings = Field(description="Of the fit.")


async def take_turn(
    fit: FitDep,
    request: Request,
    refine: RefineQuery = None,
    frame: FrameQuery = None,
    up: UpQuery = None,
    uncertainty: UncertaintyQuery = None,
    format: FormatQuery = None,
    frames: FramesQuery = None,
) -> AsyncIterator[None]:
    """Have a reconstruction that is made whole in memory wait its turn, as large uploads do."""
    few = frames is not None and len(frames_of(fit, frames)) <= FEW_FRAMES
    whole = frame == "room" or (frames is not None and not few)
    in_parts = not whole or few or chosen_format(request, format) == "json"
    stored = _is_stored(fit, refine, uncertainty)
    if in_parts and up is None and stored:  # `up` may read all frames
        yield
    else:
        async with request.app.state.large_uploads.turn(request):
            yield


@router.get(
    "/{fit_id}/reconstruction",
    response_model=Reconstruction,
    dependencies=[Depends(take_turn, scope="function")],
    responses=problems("not_found", "conflict", "not_acceptable", "range_not_satisfiable")
    | file_responses("Every frame of the fitted dataset, lifted.", OCTETS, NPZ),
)
def get_reconstruction(
    fit: FitDep,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    settings: SettingsDep,
    request: Request,
    refine: RefineQuery = None,
    frame: FrameQuery = None,
    up: UpQuery = None,
    uncertainty: UncertaintyQuery = None,
    format: FormatQuery = None,
    frames: FramesQuery = None,
) -> Response:
    """Download every frame of the fitted dataset, lifted: structures, cameras, errors.

    As JSON, or as the arrays `points3d` (N, P, 3), `rotations` (N, K, 3, 3), `scales` (N, K),
    `translations` (N, K, 3), `focals` (N, K, 2), `principal_points` (N, K, 2), `distortions`
    (N, K, 8), `reprojection_errors` (N, K), NaN where there is no answer; `keypoints_used` (N, K)
    and `camera_models` (N, K): 0 weak perspective, 1 perspective, 2 fisheye, -1 no camera. The
    translation of a weak-perspective camera is (x, y) in pixels and NaN. `points3d_sd` (N, P) is
    how far each point may be off: the root mean square of its expected distance from the true one,
    NaN where it is not known. `keypoints_seen` (N, P)
    counts the views that show a keypoint, 0 where it is inferred from the others; a keypoint that
    two views of the fit never show in the same frame is NaN, as is one that fewer than two views
    show of a frame if its answer is far from where it usually is. `outlier_probability` (N, K, P)
    is the probability of a keypoint to be an outlier, NaN where it was not observed or not judged;
    above 0.5 it was left out. `quality` (N,) in [0, 1] is how far a frame may be relied on, NaN
    where it is not known, and `quality_reason` (N,) why it is below 0.5: 1 `little_evidence`, 2
    `views_disagree`, 3 `unlike_fit`, 4 `no_evidence`, else 0. `findings` (N,) are sums of the
    findings of a frame: 1 `rig_not_used`, 2 `frame_unlike_fit`, 4 `coordinates_of_another_scale`,
    8 `not_in_room`. Reconstructions that older versions stored lack these six.

    With `frame=room` all frames are in one room, and so are the cameras. Canonical translations
    have the unit of each frame's first view: if that view moves while others are static, the unit
    differs from frame to frame. In the room there is one unit.

    While the network is still taught, the answer is that of geometry, if static cameras were
    found: `stage` is `geometry` (in the metadata of safetensors, too), and `answer_stage` of the
    fit.

    With the fit's own `refine`, or without, the stored reconstruction is returned. With another
    `refine`, and with `uncertainty=full`, the frames are lifted for this request, by the fit's
    model, which takes longer. `full` adds `points3d_covariance` (N, P, 6), the covariance C of each
    point as xx, xy, xz, yy, yz, zz, and `points3d_modes` (N, P, 3, 12), U, how points are off
    together: the covariance of all coordinates of a structure is blockdiag(C - U U^T) + U U^T.
    """
    about = {
        "fit_id": fit.id,
        "model_id": fit.model_id,
        "dataset_id": fit.dataset_id,
        "stage": answer_stage(fit),
    }
    findings = [FindingForm.model_validate(finding) for finding in fit.findings or []]
    filename = f"{fit.id}-reconstruction"
    direction = read_up(up)
    in_room = is_room(frame, direction)
    chosen, wanted = chosen_format(request, format), uncertainty or "sd"
    room = room_of(fit, store, engine, rooms, direction) if in_room else None
    if frames is not None:
        _check_is_stored(fit, refine, uncertainty)
        found = of_uncertainty(stored_frames(store, fit, frames), wanted)
    elif _is_stored(fit, refine, uncertainty):
        if chosen == "json":
            identity = (
                request.app.version,
                reconstruction_key(fit),
                about,
                findings,
                frame,
                direction,
                wanted,
            )
            parts: Iterator[Arrays] = (
                of_uncertainty(_completed(part), wanted)
                for part in reconstruction_parts(store, fit)
            )
            if room is not None:
                parts = map(room.place_arrays, parts)
            return streamed_response(
                request,
                json_pieces(parts, about, findings),
                media_type=JSON,
                checksum=hashlib.sha256(repr(identity).encode()).hexdigest(),
            )
        metadata = metadata_of(about, findings)
        file = None
        if room is None:
            file = reconstruction_file(store, fit, chosen, metadata, wanted)
        if file is not None:
            return ranged_response(
                request,
                file.size,
                partial(file.read, lookup.reader_of(store, records.FitRecord, fit.id)),
                media_type=NPZ if chosen == "npz" else OCTETS,
                filename=f"{filename}.{chosen}",
                checksum=file.checksum(),
            )
        found = of_uncertainty(stored_arrays(fit, store), wanted)
    else:
        found = _lift_again(fit, refine, wanted, store, engine, settings)
    if room is not None:
        found = room.place_arrays(found)
    return arrays_response(request, found, about, findings, format=chosen, filename=filename)


def frames_of(fit: records.FitRecord, frames: str) -> range:
    """Return the frames of a fit that a query asks for."""
    return range(fit.frames)[slice(*(int(part) if part else None for part in frames.split(":")))]


def stored_frames(store: StoreDep, fit: records.FitRecord, frames: str) -> Arrays:
    """Return some frames of what a fit stored.

    Raises
    ------
    ApiError
        422 if it has none of them.
    """
    wanted = frames_of(fit, frames)
    if not wanted:
        raise invalid("/frames", f"expected some of the fit's {fit.frames} frames, got {frames!r}")
    parts = [_completed(part) for part in reconstruction_parts(store, fit, wanted)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _check_is_stored(
    fit: records.FitRecord, refine: Refine | None, uncertainty: Uncertainty | None
) -> None:
    """Raise ``ApiError`` if some frames are wanted otherwise than a fit stored them."""
    if not _is_stored(fit, refine, None):
        raise invalid("/refine", "expected none beside frames: they are of what the fit stored")
    if uncertainty == "full":
        raise invalid(
            "/uncertainty",
            "expected sd or off beside frames: they are of what the fit stored, which is without "
            "covariances. Leave frames out, or lift these frames with POST /lift",
        )


def _is_stored(
    fit: records.FitRecord, refine: Refine | None, uncertainty: Uncertainty | None
) -> bool:
    """Return whether a fit stored its frames with this refinement, and with as much as is asked."""
    known = uncertainty != "full"
    return known and refine in (None, fit.config.get("refine", "off"))  # older fits refined nothing


def stored_arrays(fit: records.FitRecord, store: StoreDep) -> Arrays:
    """Return the reconstruction that a fit stored, in canonical frames."""
    return _completed(safetensors_arrays(answers.load_reconstruction(store, fit)))


def _completed(arrays: Arrays) -> Arrays:
    """Return a stored reconstruction, with what those stored by older versions lack."""
    if "camera_models" in arrays:
        return arrays
    scales = arrays["scales"]
    return arrays | {
        "translations": np.concatenate(
            (arrays["translations"], np.full_like(scales[..., None], np.nan)), -1
        ),
        "focals": np.full((*scales.shape, 2), np.nan, np.float32),
        "principal_points": np.full((*scales.shape, 2), np.nan, np.float32),
        "distortions": np.full((*scales.shape, 8), np.nan, np.float32),
        "camera_models": np.where(np.isfinite(scales), 0, -1).astype(np.int8),
    }


def _lift_again(
    fit: records.FitRecord,
    refine: Refine | None,
    uncertainty: Uncertainty,
    store: StoreDep,
    engine: EngineDep,
    settings: SettingsDep,
) -> Arrays:
    """Lift the frames of a fit with its model, otherwise than the fit stored them.

    Raises
    ------
    ConflictError
        If it has no model, or no longer.
    NotFoundError
        If its dataset was deleted.
    ApiError
        422 if there are more frames than in one lift, or their covariances are more than a body.
    """
    model_id = model_of(fit)
    dataset = lookup.get(store, records.DatasetRecord, fit.dataset_id)
    _check_size(fit, dataset, uncertainty, settings)
    capture = fits.load_fitted(store, fit)
    prior = engine.models.get(store.project, model_id).prior
    shown = capture.keypoints, capture.confidence, datasets.times_of(dataset, capture)
    film = film_of(prior, shown)
    lift = film.lift(film.own, refine=refine, uncertainty=uncertainty)
    return of_uncertainty(lift.arrays, uncertainty)


def _check_size(
    fit: records.FitRecord,
    dataset: records.DatasetRecord,
    uncertainty: Uncertainty,
    settings: SettingsDep,
) -> None:
    """Raise ``ApiError`` unless the frames of a fit may be lifted for one request."""
    field = "/uncertainty" if uncertainty == "full" else "/refine"
    if fit.frames > settings.max_frames:
        raise invalid(
            field,
            f"expected a fit of {settings.max_frames} frames at most, this one has {fit.frames}: "
            "leave it out for what the fit stored, or lift the frames in parts with POST /lift",
        )
    size = answer_bytes(fit.frames, dataset.views, dataset.keypoints, uncertainty)
    if uncertainty == "full" and size > settings.max_body_bytes:
        raise invalid(
            field,
            f"expected an answer of {settings.max_body_bytes} bytes at most, this would have "
            f"{size}: have the dataset lifted by workers, whose results have any length "
            '(POST /lifts with "uncertainty": "full")',
        )


def model_of(fit: records.FitRecord) -> str:
    """Return the identifier of a fit's model; raise ``ConflictError`` if it has none."""
    if fit.model_id is None:
        going_on = fit.status in ("queued", "running")
        why = (
            "it is there when it has succeeded"
            if going_on
            else "it has not succeeded, or the model was deleted"
        )
        raise ConflictError(f"Fit {fit.id!r} ({fit.status}) has no model, which this needs: {why}.")
    return fit.model_id


def answering(fit: records.FitRecord, store: Store, engine: Engine) -> WarmModel:
    """Return the model that the answer of a fit is of, also that of its first answer.

    Raises ``ConflictError`` if there is none.
    """
    if answer_stage(fit) == "geometry":
        return engine.models.first(fit)
    if fit.model_id is None:
        reconstruction_key(fit)
    return engine.models.read(store.project, model_of(fit))


def room_of(
    fit: records.FitRecord, store: Store, engine: Engine, rooms: Rooms, up: Up | None
) -> Room:
    """Return the room of a fit's answer; raise ``ConflictError`` if there is none."""
    return rooms.find(answering(fit, store, engine), up)
