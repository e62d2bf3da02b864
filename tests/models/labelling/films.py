"""A film of a walking figure by static cameras, and what a perfect fit would find of it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.labelling.evidence import Evidence, weigh
from models.labelling.filmed import Filmed, as_filmed
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, around
from tests.models.walk import walk

FRAMES, NOISE = 240, 1.0
AZIMUTHS = [0.0, 80.0, 160.0, -100.0]
SIZES: list[tuple[int, int] | None] = [IMAGE_SIZE] * len(AZIMUTHS)
Array = NDArray[Any]


def reconstruction(points: Array, keypoints: Array) -> dict[str, Array]:
    """Return the arrays of a fit that found the truth, and judged no outliers."""
    frames, views = keypoints.shape[:2]
    turns, shifts = around(AZIMUTHS[:views])
    there: Array = np.asarray(np.isfinite(keypoints).all(-1).any(-1))  # (N, K)
    shape = (frames, views)

    def of_camera(values: Array) -> Array:
        every = np.broadcast_to(values, (*shape, *np.shape(values)[-1:]))
        return np.where(there[..., None], every, np.nan).astype(np.float32)

    return {
        "points3d": points.astype(np.float32),
        "rotations": np.where(there[..., None, None], turns, np.nan).astype(np.float32),
        "scales": np.where(there, 1.0, np.nan).astype(np.float32),
        "translations": np.where(there[..., None], shifts, np.nan).astype(np.float32),
        "focals": of_camera(np.full(2, FOCAL)),
        "principal_points": of_camera(np.array([640.0, 512.0])),
        "distortions": of_camera(np.zeros(8)),
        "camera_models": np.where(there, 1, -1).astype(np.int8),
        "findings": np.zeros(frames, np.uint8),
    }


def walked(views: int = 4, frames: int = FRAMES, *, late: float = 0) -> tuple[Array, Array]:
    """Return points (N, P, 3), and keypoints (N, K, P, 2) whose last view is late."""
    moments = np.arange(40.0, 40 + frames)
    turns, shifts = around(AZIMUTHS[:views])
    rng = np.random.default_rng(2)
    keypoints = []
    for view in range(views):
        seen = walk(moments - (late if view == views - 1 else 0))
        pixels = Lens().project(seen @ turns[view].T + shifts[view])
        keypoints.append(pixels + NOISE * rng.standard_normal(pixels.shape))
    return walk(moments), np.stack(keypoints, axis=1)


def filmed(points: Array, keypoints: Array, **more: Any) -> tuple[Filmed, Evidence]:
    """Return what labels are made of."""
    found = reconstruction(points, keypoints) | more.pop("found", {})
    film = as_filmed(keypoints, more.pop("confidence", None), found, **more)
    return film, weigh(film)
