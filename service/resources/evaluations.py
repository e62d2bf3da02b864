"""Evaluations: structures and cameras against a truth, answered and not stored."""

from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Request

from service.http.dependencies import SettingsDep, StoreDep
from service.http.errors import BODY_PROBLEMS, invalid, problems
from service.http.operations import request_body
from service.http.uploads import Upload, UploadBody
from service.realtime.dependencies import EngineDep, RoomsDep
from service.realtime.engine import Engine
from service.resources.reconstructions import model_of, stored_arrays
from service.settings import Settings
from service.wire.cameras import ModelCameras
from service.wire.captures import to_array
from service.wire.evaluations import (
    CameraFigures,
    Cameras,
    Evaluation,
    Figures,
    Float32,
    Float64,
    calibrated,
    found_cameras,
    triangulated,
)
from service.wire.json_bodies import read_json
from service.wire.requests import EvaluationCreate
from store import datasets, lookup, records
from store.capture import Capture
from store.database import Store

router = APIRouter(tags=["evaluations"])


async def take_turn(request: Request, upload: UploadBody) -> AsyncIterator[Upload]:
    """Have a few evaluations at a time: each may hold hundreds of megabytes."""
    async with request.app.state.calculations.turn(request):
        yield upload


UploadInTurn = Annotated[Upload, Depends(take_turn, scope="function")]


@router.post(
    "/evaluations",
    responses=problems(*BODY_PROBLEMS, "not_found", "conflict"),
    openapi_extra=request_body(EvaluationCreate),
)
def evaluate(
    upload: UploadInTurn,
    store: StoreDep,
    engine: EngineDep,
    rooms: RoomsDep,
    settings: SettingsDep,
) -> Evaluation:
    """Measure structures against a ground truth: PA-MPJPE, MPJPE, PCK with its area.

    The structures are those of a fit, or `points`; the truth is in a dataset, or comes as `truth`.
    Beside them, on demand, the fit's cameras against a `calibration`, and the baseline of
    triangulated keypoints. Nothing is stored. A mirror image is an error unless it is forgiven.
    """
    asked = read_json(upload, EvaluationCreate)
    fit = _fit(asked, store)
    dataset, capture = _dataset(asked, fit, store, settings)
    limit = upload.max_array_bytes
    truth = _truth(asked, capture, settings, limit)
    if fit is None:
        points = _nested(asked.points, "points", settings, limit)
    else:
        found = stored_arrays(fit, store)
        if asked.frame == "room":
            model = engine.models.read(store.project, model_of(fit))
            found = rooms.find(model, None).place_arrays(found)
        points = found["points3d"]
    figures = _measure(asked, points, truth)

    cameras: Cameras | None = None
    if fit is not None and (asked.calibration is not None or asked.triangulate == "found"):
        cameras = _found(model_of(fit), engine, store)
    compared = None
    if cameras is not None and asked.calibration is not None:
        with _refused_as("/calibration"):
            compared = CameraFigures.compare(cameras, asked.calibration)
    baseline = None
    if asked.triangulate is not None:
        baseline = _measure(asked, _triangulated(asked, capture, cameras), truth)
    skeleton = dataset.skeleton if dataset is not None else None
    return Evaluation(
        **figures.model_dump(),
        keypoint_names=skeleton["keypoint_names"] if skeleton else None,
        cameras=compared,
        triangulation=baseline,
    )


def _fit(asked: EvaluationCreate, store: Store) -> records.FitRecord | None:
    if (asked.fit_id is None) == (asked.points is None):
        raise invalid("/fit_id", "expected a fit or points, one of the two")
    return None if asked.fit_id is None else lookup.get(store, records.FitRecord, asked.fit_id)


def _dataset(
    asked: EvaluationCreate, fit: records.FitRecord | None, store: Store, settings: Settings
) -> tuple[records.DatasetRecord | None, Capture | None]:
    """Return the dataset that is compared with, and its frames; those that the fit saw."""
    identifier = asked.dataset_id or (fit.dataset_id if fit is not None else None)
    if identifier is None or (asked.dataset_id is None and asked.truth is not None):
        return None, None
    dataset = lookup.get(store, records.DatasetRecord, identifier)
    frames = fit.frames if fit is not None and fit.dataset_id == identifier else dataset.frames
    if frames > settings.max_frames:
        raise invalid(
            "/dataset_id",
            f"expected {settings.max_frames} frames at most, got {frames}: compare them in parts, "
            "as `fewview evaluate` does with files",
        )
    return dataset, datasets.load(store, identifier, frames=frames)


def _truth(
    asked: EvaluationCreate, capture: Capture | None, settings: Settings, limit: int
) -> Float32:
    if asked.truth is not None:
        return _nested(asked.truth, "truth", settings, limit)
    if capture is None:
        raise invalid("/truth", "expected a truth, or a dataset that has one")
    if capture.points3d is None:
        raise invalid("/truth", "the dataset has no ground truth: send it here")
    return capture.points3d


def _nested(value: object, name: str, settings: Settings, limit: int) -> Float32:
    """Return structures (N, P, 3) that came as nested lists."""
    found = to_array(value, name, (None, None, None, 2), limit)
    if len(found) > settings.max_frames:
        raise invalid(
            f"/{name}", f"expected {settings.max_frames} frames at most, got {len(found)}"
        )
    return found


def _measure(asked: EvaluationCreate, points: Float32 | Float64, truth: Float32) -> Figures:
    with _refused_as("/points" if asked.points is not None else "/truth"):
        return Figures.of(points, truth, asked.reach, mirrored_too=asked.mirrored_too)


def _found(model_id: str, engine: Engine, store: Store) -> Cameras:
    with _refused_as("/fit_id"):
        model = engine.models.read(store.project, model_id)
        return found_cameras(ModelCameras.of(model_id, model.prior.cameras, model.best_frame))


def _triangulated(
    asked: EvaluationCreate, capture: Capture | None, cameras: Cameras | None
) -> Float64:
    if capture is None:
        raise invalid("/triangulate", "expected a dataset, whose keypoints are triangulated")
    if asked.triangulate == "calibration":
        if asked.calibration is None:
            raise invalid("/calibration", "expected the cameras to triangulate with")
        with _refused_as("/calibration"):
            cameras = calibrated(asked.calibration)
    if cameras is None:
        raise invalid("/triangulate", "expected a fit, whose cameras are found")
    if len(cameras) != capture.keypoints.shape[1]:
        views = capture.keypoints.shape[1]
        raise invalid("/triangulate", f"expected {views} cameras, got {len(cameras)}")
    with _refused_as("/triangulate"):
        return triangulated(np.where(capture.seen[..., None], capture.keypoints, np.nan), cameras)


@contextmanager
def _refused_as(pointer: str) -> Iterator[None]:
    """Have what cannot be computed refused with the field that it is of."""
    try:
        yield
    except ValueError as error:
        raise invalid(pointer, str(error)) from error
