"""Animations: the structures of a fit as files of biomechanics and of graphics."""

from collections.abc import AsyncIterator
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request
from starlette.responses import Response

from service.http.dependencies import StoreDep
from service.http.downloads import bytes_response
from service.http.errors import invalid, problems
from service.http.negotiation import OCTETS
from service.http.operations import file_responses
from service.realtime.dependencies import EngineDep, RoomsDep
from service.resources.fits import FitDep
from service.resources.reconstructions import (
    FramesQuery,
    frames_of,
    model_of,
    room_of,
    stored_arrays,
    stored_frames,
)
from service.wire.animations import AnimationFormat, LengthUnit, animation_file
from service.wire.rooms import FrameQuery, UpQuery, is_room, read_up
from service.wire.skeletons import Skeleton
from store import datasets, lookup, records
from store.answers import answer_stage, reconstruction_key
from store.database import Store
from store.errors import NotFoundError

router = APIRouter(prefix="/fits", tags=["fits"])

MOST_POINTS = 3_000_000  # in one file: the slowest format, BVH, takes half a minute for as many


async def take_turn(request: Request) -> AsyncIterator[None]:
    """Have animations, which are made whole in memory, wait their turn as large uploads do."""
    async with request.app.state.large_uploads.turn(request):
        yield


@router.get(
    "/{fit_id}/animation",
    response_class=Response,
    dependencies=[Depends(take_turn, scope="function")],
    responses=problems("not_found", "conflict", "range_not_satisfiable")
    | file_responses("The structures as a file of the format.", OCTETS),
)
def download_animation(
    fit: FitDep,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    request: Request,
    format: Annotated[
        AnimationFormat,
        Query(
            description="`trc` (OpenSim), `c3d` (biomechanics), `bvh` (a skeleton, where edges "
            "form a tree), `glb` (glTF 2.0, for viewers and Blender), `csv` (a row for each "
            "frame), `csv-tidy` (a row for each point). How far points may be off is in the "
            "columns `sd` of CSV and the residuals of C3D."
        ),
    ],
    frame: FrameQuery = None,
    up: UpQuery = None,
    frames: FramesQuery = None,
    unit: Annotated[
        LengthUnit | None,
        Query(
            description="Unit of the lengths that the fit was given; `trc` needs it, others name "
            "it where they can. Nothing is converted."
        ),
    ] = None,
) -> Response:
    """Download the structures of every fitted frame, or of some `frames`, as an animation.

    Tools expect y up, as with `frame=room&up=auto`. Keypoints have the names of the model's
    skeleton. Times are those of the dataset, or else 30 frames/s.
    """
    keypoints, named = _described(fit, store)
    wanted = range(fit.frames) if frames is None else frames_of(fit, frames)
    if len(wanted) * keypoints > MOST_POINTS:
        raise invalid(
            "/frames",
            f"expected {MOST_POINTS} points at most, frames times keypoints, got "
            f"{len(wanted)} x {keypoints}: ask for a part, such as "
            f"frames=0:{MOST_POINTS // keypoints}",
        )
    found = stored_arrays(fit, store) if frames is None else stored_frames(store, fit, frames)
    direction = read_up(up)
    if is_room(frame, direction):
        found = room_of(fit, store, engine, rooms, direction).place_arrays(found)
    skeleton = Skeleton.model_validate(named or {})
    fps, times = _moments(fit, store, wanted)
    file = animation_file(
        found["points3d"],
        found.get("points3d_sd"),
        skeleton,
        format=format,
        unit=unit,
        fps=fps,
        times=times,
    )
    filename = f"{fit.id}{file.suffix}"
    return bytes_response(request, file.content, media_type=OCTETS, filename=filename)


def _described(fit: records.FitRecord, store: Store) -> tuple[int, dict[str, Any] | None]:
    """Return the keypoints of a fit's answer, and their skeleton."""
    described: records.DatasetRecord | records.ModelRecord
    if answer_stage(fit) == "geometry":
        described = lookup.get(store, records.DatasetRecord, fit.dataset_id)
    else:
        reconstruction_key(fit)
        described = lookup.get(store, records.ModelRecord, model_of(fit))
    return described.keypoints, described.skeleton


def _moments(
    fit: records.FitRecord, store: Store, wanted: range
) -> tuple[float | None, np.ndarray[tuple[int], np.dtype[np.float64]] | None]:
    """Return frames per second and times (N,) in seconds of N frames that are wanted.

    None where the dataset has none.
    """
    try:
        dataset = lookup.get(store, records.DatasetRecord, fit.dataset_id)
        fps = None if dataset.fps is None else dataset.fps / wanted.step
        if dataset.last_times is None:
            return fps, None
        times = datasets.load(store, fit.dataset_id, frames=fit.frames).times
    except NotFoundError:  # it was deleted since
        return None, None
    if times is not None and times.ndim == 2:
        times = np.nanmedian(times, axis=1)
    return fps, None if times is None else times[wanted.start : wanted.stop : wanted.step]
