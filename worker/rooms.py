"""The room of a model: the frame of reference of its static cameras, in which a subject moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from fewview.geometry.placing import in_room
from fewview.geometry.rigs import in_rig
from numpy.typing import NDArray
from safetensors.numpy import load

from models.calibrating.result import CameraReport
from models.lifting.lift import LiftedFrames
from models.network.answers import NOT_IN_ROOM
from models.settings.rooms import BestFrame, Up
from store import answers, lookup
from store.database import Store
from store.errors import ConflictError
from store.records import DatasetRecord, FitRecord, ModelRecord

Arrays = dict[str, NDArray[Any]]
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Room:
    """Where the K views of a fit stand.

    Attributes
    ----------
    rotations, translations
        (K, 3, 3) and (K, 3): `x_cam = R X_room + t` in the unit of the model's structures, NaN for
        views that move.
    """

    rotations: Float64
    translations: Float64

    def knows(self, views: Sequence[int] | None, count: int) -> bool:
        """Return whether the ``count`` views of a lift are known views of the fit."""
        return views is not None or count == len(self.rotations)

    def place_arrays(self, arrays: Arrays, views: Sequence[int] | None = None) -> Arrays:
        """Return the arrays of a lift of some views of the fit in the room.

        Each frame is placed on its own. Frames with a structure and without a place get the finding
        `not_in_room`, and so do all frames of unknown views.
        """
        count = arrays["scales"].shape[1]
        if views is not None:
            rotations, translations = self.rotations[views], self.translations[views]
        elif self.knows(views, count):
            rotations, translations = self.rotations, self.translations
        else:
            rotations, translations = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        placed = in_room(arrays, rotations, translations)
        there, here = (
            np.asarray((found["camera_models"] >= 0).any(axis=1)) for found in (arrays, placed)
        )
        findings = arrays.get("findings", np.zeros(len(there), np.uint8))
        placed["findings"] = findings | (NOT_IN_ROOM * (there & ~here)).astype(np.uint8)
        return placed

    def place(self, lift: LiftedFrames, views: Sequence[int] | None) -> LiftedFrames:
        """Return a lift in the room; see :meth:`place_arrays`."""
        return lift._replace(**self.place_arrays(lift.arrays, views))


def find_room(store: Store, model_id: str, cameras: CameraReport | None, up: Up | None) -> Room:
    """Return the room of a model: with y up if `up` is given, else as its cameras are.

    Up is a vector in the frame of reference of the model's cameras, or estimated from the frames
    that the model was fitted to. Their feet, if keypoints are named so, are on the floor, y = 0.

    Raises
    ------
    NotFoundError
        If there is no such model.
    ConflictError
        If it has no static cameras, or `up` is to be estimated and cannot be.
    """
    known = _with_static(f"Model {model_id!r}", cameras)
    if up is None:
        return Room(known.rotations, known.translations)
    model = lookup.get(store, ModelRecord, model_id)
    frames = _fitted_frames(store, model, len(known.static))
    if up == "auto" and not len(frames["points3d"]):
        raise ConflictError(
            f"up: 'auto' is found from the frames of the fit, and model {model_id!r} has none: it "
            "was imported, or the fit was deleted. Give up as a vector (x, y, z)."
        )
    return _upright(known, frames, model.skeleton, up)


def find_first_room(
    store: Store, fit: FitRecord, cameras: CameraReport | None, up: Up | None
) -> Room:
    """Return the room of a fit's first answer; see `find_room`."""
    known = _with_static(f"The first answer of fit {fit.id!r}", cameras)
    if up is None:
        return Room(known.rotations, known.translations)
    skeleton = lookup.get(store, DatasetRecord, fit.dataset_id).skeleton
    return _upright(known, load(answers.load_reconstruction(store, fit)), skeleton, up)


def _with_static(whose: str, cameras: CameraReport | None) -> CameraReport:
    """Return cameras of which some are static; raise ``ConflictError`` if none is."""
    if cameras is None or not has_room(cameras):
        arrangement = "unknown" if cameras is None else cameras.arrangement
        raise ConflictError(
            f"{whose} has no room: none of its cameras is static (arrangement: "
            f"{arrangement}). Ask for frame=canonical, or fit with `refine` and static cameras."
        )
    return cameras


def has_room(cameras: CameraReport | None) -> bool:
    """Return whether any camera of a model is static, so that it has a room."""
    return cameras is not None and bool(cameras.static.any())


def best_frame(
    cameras: CameraReport | None, frames: Arrays, skeleton: dict[str, Any] | None
) -> BestFrame:
    """Return the best frame of reference that the lifted frames of a fit can be shown in."""
    if cameras is None or not has_room(cameras):
        return "canonical"
    try:
        _upright(cameras, frames, skeleton, "auto")
    except ConflictError:
        return "room"
    return "upright"


def first_frame(store: Store, fit: FitRecord, cameras: CameraReport | None) -> BestFrame:
    """Return the best frame of reference of a fit's first answer."""
    skeleton = lookup.get(store, DatasetRecord, fit.dataset_id).skeleton
    return best_frame(cameras, load(answers.load_reconstruction(store, fit)), skeleton)


def _upright(
    cameras: CameraReport, frames: Arrays, skeleton: dict[str, Any] | None, up: Up
) -> Room:
    try:
        room = in_rig(
            frames["points3d"],
            frames["rotations"],
            frames["translations"],
            frames["camera_models"],
            cameras.rotations,
            cameras.translations,
            up=up,
            keypoint_names=(skeleton or {}).get("keypoint_names"),
        )
    except ValueError as error:
        raise ConflictError(f"up: {error}. Give it as a vector (x, y, z).") from error
    return Room(room.rotations, room.translations)


def _fitted_frames(store: Store, model: ModelRecord, views: int) -> Arrays:
    """Return the reconstruction of a model's fit; no frames where there is none."""
    if model.fit_id is not None:
        return load(answers.load_reconstruction(store, lookup.get(store, FitRecord, model.fit_id)))
    return {
        "points3d": np.empty((0, model.keypoints, 3)),
        "rotations": np.empty((0, views, 3, 3)),
        "translations": np.empty((0, views, 3)),
        "camera_models": np.empty((0, views)),
    }
