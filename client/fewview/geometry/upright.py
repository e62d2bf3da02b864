"""Which way is up, and where the floor is, from the subject alone."""

import re
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64 = NDArray[np.float64]
Up = ArrayLike | Literal["auto"] | None

FEET = re.compile(r"foot|feet|ankle|heel|toe|paw|hoof|hooves", re.IGNORECASE)
LOW = 0.1  # the share of the frames' lowest feet that may be below the floor
ONE_WAY = 0.8  # of the long axes' spread must lie along their mean, or up is undetermined
WIDE = 0.25  # of the body's height: a floor that feet cover less than this has no slope to see
STEEPEST = np.cos(np.radians(30))  # a plane more oblique to the body than this is no floor


def feet_of(names: Sequence[str] | None) -> list[int]:
    """Return the places of keypoints that touch the floor, by their names."""
    return [place for place, name in enumerate(names or ()) if FEET.search(name)]


def find_up(points: Float64, feet: Sequence[int]) -> tuple[Float64, str]:
    """Estimate the unit vector up (3,) in the axes of points (N, P, 3); return also a note on it.

    If feet are known, they are below the other keypoints. If they were put down over a wide enough
    area, the plane of their lowest positions is level. Otherwise the body's long axis is upright on
    average, with its upper end towards the top of the images (-y).

    Raises
    ------
    ValueError
        If there are no feet and no axis stands out.
    """
    if feet:
        up = _above_feet(points, feet)
        level = _floor_normal(points[:, feet], up, _height(points, up))
        if level is None:
            return up, "up is where the body is seen from its feet"
        return level, "up stands on the plane of the feet's lowest positions"
    frames = points[np.isfinite(points).all((1, 2))]
    centred = frames - frames.mean(1, keepdims=True) if len(frames) else np.empty((0, 1, 3))
    axes = np.linalg.eigh(np.einsum("npi,npj->nij", centred, centred))[1][..., -1]
    spread, found = np.linalg.eigh(axes.T @ axes / max(len(axes), 1))
    if spread[-1] < ONE_WAY:
        raise ValueError(
            "no axis of the subject stands out as upright: give `up`, or keypoint names with feet"
        )
    up = found[:, -1]
    return (-up if up[1] > 0 else up), "up is the body's long axis, averaged over the frames"


def upright_axes(up: ArrayLike) -> Float64:
    """Return the rotation (3, 3) to axes with y up, x the old x made level, z = x cross y.

    For a level camera's axes (x right, y down, z forward) these are x right, y up, z backward: the
    axes of glTF, BVH and OpenSim.

    Raises
    ------
    ValueError
        If `up` is no vector of three finite numbers, or zero.
    """
    y = np.asarray(up, dtype=np.float64)
    if y.shape != (3,) or not np.isfinite(y).all() or not y.any():
        raise ValueError(f"up must be 'auto' or a vector (x, y, z) other than zero, not {up!r}")
    y = y / np.abs(y).max()  # else the squares of small numbers would be zero
    y = y / np.linalg.norm(y)
    side = np.eye(3)[0 if abs(y[0]) < 0.99 else 2]
    x = side - (side @ y) * y
    x /= np.linalg.norm(x)
    return np.stack((x, y, np.cross(x, y)))


def floor_height(points: Float64, feet: Sequence[int]) -> float:
    """Return the y of the floor under feet of points (N, P, 3) with y up; NaN without any."""
    heights = points[:, feet, 1]
    lowest = np.where(np.isfinite(heights), heights, np.inf).min(1)
    lowest = lowest[np.isfinite(lowest)]
    return float(np.quantile(lowest, LOW)) if len(lowest) else np.nan


def _above_feet(points: Float64, feet: Sequence[int]) -> Float64:
    """Return the median direction (3,) from the feet to the other keypoints."""
    body = np.delete(points, feet, axis=1)
    whole = np.isfinite(points[:, feet]).all((1, 2)) & np.isfinite(body).any((1, 2))
    if not whole.any() or not body.shape[1]:
        raise ValueError("no frame shows feet and the body above them: give `up`")
    direction = np.nanmean(body[whole], axis=1) - points[whole][:, feet].mean(1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    up = np.median(direction, axis=0)
    return np.asarray(up / np.linalg.norm(up), dtype=np.float64)


def _height(points: Float64, up: Float64) -> float:
    """Return the median over frames of the body's extent along `up`."""
    along = points @ up
    along = along[np.isfinite(along).any(1)]
    return float(np.median(np.nanmax(along, axis=1) - np.nanmin(along, axis=1)))


def _floor_normal(feet: Float64, up: Float64, height: float) -> Float64 | None:
    """Return the normal (3,) of the plane under feet (N, F, 3), or None if they cover too little.

    A tenth of each frame's lowest foot lies below the plane (quantile regression by reweighting).
    """
    along = np.where(np.isfinite(feet).all(-1), feet @ up, np.inf)
    lowest = np.take_along_axis(feet, along.argmin(1)[:, None, None], axis=1)[:, 0]
    lowest = lowest[np.isfinite(lowest).all(-1)]
    level = upright_axes(up)
    across = (lowest - lowest.mean(0)) @ level.T
    ground = across[:, [0, 2]]
    if len(ground) < 10 or np.linalg.svd(ground, compute_uv=False)[-1] < WIDE * height * np.sqrt(
        len(ground)
    ):
        return None
    design = np.column_stack((ground, np.ones(len(ground))))
    weights = np.ones(len(ground))
    for _ in range(50):
        root = np.sqrt(weights)[:, None]
        slope = np.linalg.lstsq(design * root, across[:, 1] * root[:, 0])[0]
        above = across[:, 1] - design @ slope
        weights = np.where(above > 0, LOW, 1 - LOW) / np.maximum(np.abs(above), 1e-3 * height)
    normal = level.T @ np.array([-slope[0], 1.0, -slope[1]])
    normal /= np.linalg.norm(normal)
    return normal if normal @ up > STEEPEST else None
