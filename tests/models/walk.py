"""A figure that walks about and moves its limbs over time, seen by static cameras."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from models.capture.synthetic import synthetic_capture
from tests.models.rigs import Lens, around

Float64 = NDArray[np.float64]
LONGEST = 1000  # frames
POSE_FRAMES = 25  # from one pose of the figure to the next


def walk(moments: Float64, *, seed: int = 0) -> Float64:
    """Return the figure (T, P, 3) in metres at moments (T,), in frames from 0 to `LONGEST`."""
    rng = np.random.default_rng(seed)
    count = LONGEST // POSE_FRAMES + 6
    poses = synthetic_capture(frames=count, views=1, seed=seed).points3d.astype(np.float64)
    poses += rng.uniform(-0.5, 0.5, (count, 1, 3)) * [1, 0.1, 1]
    spline = CubicSpline(POSE_FRAMES * (np.arange(count) - 2.0), poses)
    points: Float64 = spline(moments)
    return points


def film(azimuths: list[float], moments: Float64, *, noise: float = 0.0, seed: int = 0) -> Float64:
    """Return keypoints (T, K, P, 2) of views that show the moments (T,) or (T, K)."""
    rotations, translations = around(azimuths)
    by_view = np.broadcast_to(moments.reshape(len(moments), -1), (len(moments), len(azimuths)))
    lens, views = Lens(), []
    for view, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
        views.append(lens.project(walk(by_view[:, view], seed=seed) @ rotation.T + translation))
    pixels = np.stack(views, 1)
    pixels += noise * np.random.default_rng(seed).standard_normal(pixels.shape)
    return pixels
