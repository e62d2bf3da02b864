"""The point where the rays of two views to one keypoint meet, in an explained frame."""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import LENS
from models.lifting.explanations import Explanation
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, fill
from models.optics.lenses.projection import Lenses, differentiate_into, project_into

Float64 = NDArray[np.float64]

STEPS = 6  # of Gauss and Newton
DAMPING = 1e-9  # of the largest curvature: rays may be parallel


@inner
def meet(
    lenses: Lenses,
    explanation: Explanation,
    a: int,
    b: int,
    places: Float64,
    point: Float64,
) -> float:
    """Move a point (3,) so that it projects nearest to its pixels in two views, `places` (2, 2).

    Returns the larger reprojection error of the two in pixels; infinity if there is no such point
    in front of both cameras.
    """
    camera, pixel, step = np.empty(3), np.empty(2), np.empty(3)
    by_camera, by_lens, by_point = np.empty((2, 3)), np.empty((2, LENS)), np.empty(3)
    curvature = np.empty((3, 3))
    for _ in range(STEPS):
        fill(curvature, 0.0)
        fill(step, 0.0)
        for view in range(2):
            k = a if view == 0 else b
            camera_into(explanation, k, point, camera)
            differentiate_into(camera, lenses, k, pixel, by_camera, by_lens)
            for axis in range(2):
                for j in range(3):
                    by_point[j] = 0.0
                    for i in range(3):
                        by_point[j] += by_camera[axis, i] * explanation.rotations[k, i, j]
                for i in range(3):
                    step[i] += by_point[i] * (places[view, axis] - pixel[axis])
                    for j in range(3):
                        curvature[i, j] += by_point[i] * by_point[j]
        damping = DAMPING * max(curvature[0, 0], curvature[1, 1], curvature[2, 2])
        for i in range(3):
            curvature[i, i] += damping
        if not cholesky(curvature):
            return math.inf
        cholesky_solve(curvature, step)
        for i in range(3):
            point[i] += step[i]
    worst = 0.0
    for view in range(2):
        k = a if view == 0 else b
        off = distance(lenses, explanation, k, point, places[view, 0], places[view, 1])
        worst = max(worst, off)
    return worst if math.isfinite(worst) else math.inf


@inner
def distance(
    lenses: Lenses, explanation: Explanation, k: int, point: Float64, x: float, y: float
) -> float:
    """Return the reprojection error of a point (3,) in view k; infinity if it is behind it."""
    camera, pixel = np.empty(3), np.empty(2)
    camera_into(explanation, k, point, camera)
    if not camera[2] > 0.0:
        return math.inf
    project_into(camera, lenses, k, pixel)
    return math.sqrt((pixel[0] - x) ** 2 + (pixel[1] - y) ** 2)


@inner
def camera_into(explanation: Explanation, k: int, point: Float64, camera: Float64) -> None:
    """Transform a point (3,) into the frame of reference of camera k."""
    for i in range(3):
        camera[i] = explanation.translations[k, i]
        for j in range(3):
            camera[i] += explanation.rotations[k, i, j] * point[j]
