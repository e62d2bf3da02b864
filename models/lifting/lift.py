"""What a lift returns."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import WeakPerspectiveScene
from models.findings.catalogue import LiftCode
from models.network.answers import (
    NOT_IN_ROOM,
    OTHER_SCALE,
    RIG_NOT_USED,
    UNLIKE_FIT,
    Answers,
)
from models.optics.lenses.projection import LENSES
from models.settings.keypoints import MIN_KEYPOINTS
from models.settings.uncertainty import ARRAYS

# `camera_models` are indices into this: weak perspective, then the lenses in their order.
CAMERA_MODELS = ("weak_perspective", *(lens.LIFTED_AS for lens in LENSES))
Status = Literal["ok", "too_few_keypoints", "not_in_room"]
REASONS: dict[Status, str] = {
    "ok": "",
    "too_few_keypoints": (
        f"no view shows {MIN_KEYPOINTS} keypoints or more that do not all lie at one place"
    ),
    "not_in_room": "no static camera places it in the room",
}
# The bits of the sums in `findings`.
FINDING_BITS: dict[int, LiftCode] = {
    RIG_NOT_USED: "rig_not_used",
    UNLIKE_FIT: "frame_unlike_fit",
    OTHER_SCALE: "coordinates_of_another_scale",
    NOT_IN_ROOM: "not_in_room",
}
# The arrays (N, P, ...) of points, NaN where there is no point.
_OF_POINTS = ("points3d", *ARRAYS["full"])
_INTERNAL = frozenset({"continued", "sizes", "misfits", "rig_residuals"})


class LiftedFrames(Answers):
    """Structures and cameras of N frames of K views: the arrays of `Answers`, and their status."""

    __slots__ = ()

    @property
    def status(self) -> tuple[Status, ...]:
        """Whether each of the N frames has a structure: it has one if any view has a camera."""
        lifted = np.any(self.camera_models >= 0, axis=1).tolist()
        homeless = np.not_equal(self.findings & NOT_IN_ROOM, 0).tolist()
        return tuple(
            "ok" if one else "not_in_room" if none else "too_few_keypoints"
            for one, none in zip(lifted, homeless, strict=True)
        )

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why each frame has its status, in words; empty where it is ok."""
        return tuple(REASONS[status] for status in self.status)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays under the names that they have in files and on the wire."""
        arrays = {name: value for name, value in self._asdict().items() if name not in _INTERNAL}
        return {
            name: value
            for name, value in arrays.items()
            if name not in ARRAYS["full"] or value.shape[-1]
        }

    def of_keypoints(self, chosen: NDArray[np.bool_]) -> "LiftedFrames":
        """Return the lift of some of the P keypoints."""
        if chosen.all():
            return self
        # Arrays with another memory order would make Numba compile again, which takes a minute.
        points = {name: np.ascontiguousarray(getattr(self, name)[:, chosen]) for name in _OF_POINTS}
        return self._replace(
            keypoints_seen=np.ascontiguousarray(self.keypoints_seen[:, chosen]),
            outlier_probability=np.ascontiguousarray(self.outlier_probability[:, :, chosen]),
            **points,
        )

    def among(self, known: NDArray[np.bool_]) -> "LiftedFrames":
        """Return the lift of Q keypoints as one of P, of which Q are known; the others are NaN."""
        if known.all():
            return self
        frames, keypoints = len(self.points3d), len(known)
        points = {}
        for name in _OF_POINTS:
            some = getattr(self, name)
            points[name] = np.full((frames, keypoints, *some.shape[2:]), np.nan, np.float32)
            points[name][:, known] = some
        seen = np.zeros((frames, keypoints), np.uint8)
        seen[:, known] = self.keypoints_seen
        judged = np.full((*self.scales.shape, keypoints), np.nan, np.float32)
        judged[:, :, known] = self.outlier_probability
        return self._replace(keypoints_seen=seen, outlier_probability=judged, **points)

    def without_points(self, nowhere: NDArray[np.bool_]) -> "LiftedFrames":
        """Return the lift with NaN for some points (N, P)."""
        if not nowhere.any():
            return self
        points = {name: getattr(self, name).copy() for name in _OF_POINTS}
        for array in points.values():
            array[nowhere] = np.nan
        return self._replace(**points)

    def frames(self, chosen: slice | NDArray[np.bool_]) -> "LiftedFrames":
        """Return some of the frames; of a slice, as views of the arrays."""
        return LiftedFrames._make(array[chosen] for array in self)


def join(lifts: Sequence[LiftedFrames]) -> LiftedFrames:
    """Join lifts of the same views and keypoints, frame after frame."""
    return LiftedFrames._make(np.concatenate(parts) for parts in zip(*lifts, strict=True))


def weak_perspective(lift: LiftedFrames) -> WeakPerspectiveScene:
    """Return structures, rotations, scales and translations (x, y) of a lift, finite everywhere."""

    def number(array: NDArray[np.float32], without: float) -> NDArray[np.float64]:
        return np.asarray(np.nan_to_num(array, nan=without), np.float64)

    rotations = number(lift.rotations, 0)
    rotations[~np.isfinite(lift.scales)] = np.eye(3)
    return WeakPerspectiveScene(
        number(lift.points3d, 0),
        rotations,
        number(lift.scales, 1),
        number(lift.translations[..., :2], 0),
    )
