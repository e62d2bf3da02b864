"""All frames of a lift in the room of a rig, upright where that is asked for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.geometry.placing import find_places
from fewview.geometry.upright import Up, feet_of, find_up, floor_height, upright_axes

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Placed:
    """Points and cameras in one frame of reference.

    Attributes
    ----------
    points
        (N, P, 3) in the unit of the lift; NaN in frames that have no perspective pose.
    rotations, translations
        (K, 3, 3) and (K, 3): `x_cam = R X_room + t` of static views, NaN for the others.
    missing
        How many frames have no place in the room.
    notes
        Sentences for people on what was done and estimated.
    scales
        (N,) by which the lengths of each frame of the lift were multiplied, so that its
        `points3d_sd` are in the room's unit, too; NaN in frames that have no place.
    """

    points: Float64
    rotations: Float64
    translations: Float64
    missing: int
    notes: tuple[str, ...]
    scales: Float64


def in_rig(
    points3d: ArrayLike,
    rotations: ArrayLike,
    translations: ArrayLike,
    camera_models: ArrayLike | None,
    rig_rotations: Float64,
    rig_translations: Float64,
    *,
    believed: int = 0,
    up: Up = None,
    floor: bool | None = None,
    keypoint_names: Sequence[str] | None = None,
) -> Placed:
    """Place the frames of a lift in the room of a rig.

    Parameters
    ----------
    rig_rotations, rig_translations
        (K, 3, 3) and (K, 3) from the room to the cameras, NaN for views that move.
    believed
        The view to use if two contradict each other.

    Raises
    ------
    ValueError
        If shapes do not fit, or up or the floor was asked for and cannot be estimated.
    """
    turns, shifts = (np.asarray(array, np.float64) for array in (rotations, translations))
    known = known_poses(points3d, turns, shifts, camera_models)
    frames, views = known.shape
    order = np.argsort(np.arange(views) != believed, kind="stable")
    order = order[np.isfinite(rig_rotations[order]).all((1, 2))]
    places = find_places(
        turns[:, order],
        shifts[:, order],
        known[:, order],
        rig_rotations[order],
        rig_translations[order],
    )
    placed = places.of(np.asarray(points3d, np.float64))
    missing = int(np.isnan(placed).all((1, 2)).sum())
    notes = []
    if missing:
        notes.append(f"{missing} of {frames} frames have no perspective pose: they are empty")
    if places.contradicted:
        notes.append(
            f"in {places.contradicted} frames views contradict each other: the fewer were left"
        )
    axes, drop, more = _upright(placed, up, floor, feet_of(keypoint_names))
    return Placed(
        points=placed @ axes.T - drop,
        rotations=rig_rotations @ axes.T,
        translations=rig_translations + rig_rotations @ (axes.T @ drop),
        missing=missing,
        notes=(*notes, *more),
        scales=np.where(np.isfinite(places.shifts[:, 0]), places.scales, np.nan),
    )


def known_poses(
    points: ArrayLike, turns: Float64, shifts: Float64, camera_models: ArrayLike | None
) -> Bool:
    """Return which views (N, K) of frames have a perspective pose; raise if shapes do not fit."""
    frames, views = turns.shape[:2]
    shape = np.shape(points)
    if shape[::2] != (frames, 3) or shifts.shape != (frames, views, 3):
        raise ValueError(
            f"expected (N, P, 3), (N, K, 3, 3) and (N, K, 3), got {shape}, {turns.shape} "
            f"and {shifts.shape}"
        )
    known: Bool = np.asarray(np.isfinite(turns).all((2, 3)) & np.isfinite(shifts).all(2))
    return known if camera_models is None else known & (np.asarray(camera_models) > 0)


def _upright(
    placed: Float64, up: Up, floor: bool | None, feet: list[int]
) -> tuple[Float64, Float64, list[str]]:
    """Return the rotation (3, 3) of the room to its axes, the offset of the floor, and notes."""
    if up is None:
        if floor:
            raise ValueError("the floor needs `up`")
        return np.eye(3), np.zeros(3), []
    notes = []
    if isinstance(up, str):
        if up != "auto":
            raise ValueError(f"up must be 'auto' or a vector (x, y, z), not {up!r}")
        up, more = find_up(placed, feet)
        notes.append(more)
    axes = upright_axes(up)
    if floor and not feet:
        raise ValueError("the floor needs names of keypoints, feet among them")
    height = floor_height(placed @ axes.T, feet) if feet and floor is not False else np.nan
    if not np.isfinite(height):
        return axes, np.zeros(3), notes
    return axes, np.array([0.0, height, 0.0]), [*notes, "y = 0 is the floor under the feet"]


def nearest_rotation(matrices: Float64) -> Float64:
    """Return the rotations (..., 3, 3) nearest to matrices in the Frobenius norm; NaN of NaN."""
    finite = np.asarray(np.isfinite(matrices).all((-2, -1)))[..., None, None]
    u, _, vt = np.linalg.svd(np.where(finite, matrices, np.eye(3)))
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.where(finite, u @ vt, np.nan)
