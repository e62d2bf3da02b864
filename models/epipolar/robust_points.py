"""Triangulation under Student's t: points of which one ray or another may be wrong.

Every pair of rays and all rays together give a start for each point; the most likely one is
improved by Gauss-Newton steps (Hartley & Zisserman, *Multiple View Geometry*, ch. 12, with the
reweighting of Triggs et al., *Bundle adjustment: a modern synthesis*, 1999).
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.epipolar.rig_adjustment import (
    FREEDOM,
    Rigid,
    Seen,
    distances_of,
    rays_of,
    residuals_by_points,
    robust_costs,
    triangulate_points,
)

Float64 = NDArray[np.float64]

ITERATIONS = 8
FIRST_DAMPING = 1e-4
PARALLEL = 1e-8  # squared sine of the angle between two rays that meet nowhere
TINY = 1e-12  # of the curvature: what keeps points of parallel rays solvable


def robust_points(rig: Rigid, seen: Seen, noise: Float64) -> Float64:
    """Return the most likely points (3, M) of what K cameras see; two rays or more of each.

    `noise` (K,) is the scale of Student's t in sides of the image.
    """

    def costs_of(points: Float64) -> Float64:
        distances = distances_of(rig, points, seen, noise)
        costs: Float64 = robust_costs(distances, seen.weights, noise).sum(0)
        return costs

    points = triangulate_points(rig, seen)
    costs = costs_of(points)
    for start in _of_pairs(rig, seen):
        tried = costs_of(start)
        better = np.isfinite(start).all(0) & (tried < costs)
        points, costs = np.where(better, start, points), np.where(better, tried, costs)
    damping = np.full(points.shape[1], FIRST_DAMPING)
    for _ in range(ITERATIONS):
        residuals, by_point = residuals_by_points(rig, points, seen)
        squared = np.square(residuals).sum(1) / np.square(noise)[:, None]
        weights = seen.weights * (FREEDOM + 2) / (FREEDOM + squared) / np.square(noise)[:, None]
        normal = np.einsum("km,kiam,kibm->mab", weights, by_point, by_point, optimize=True)
        right = -np.einsum("km,kiam,kim->ma", weights, by_point, residuals, optimize=True)
        diagonal = normal[:, range(3), range(3)]
        most = diagonal.max(1, keepdims=True)
        normal[:, range(3), range(3)] += damping[:, None] * diagonal + TINY * (most + 1)
        tried_points = points + np.linalg.solve(normal, right[..., None])[..., 0].T
        tried = costs_of(tried_points)
        better = tried <= costs
        points = np.where(better, tried_points, points)
        costs = np.where(better, tried, costs)
        damping = np.where(better, damping / 10, damping * 10)
    return points


def _of_pairs(rig: Rigid, seen: Seen) -> list[Float64]:
    """Points (3, M) midway between the rays of two views, for every two; NaN where there are not.

    With two views, that is what all rays say.
    """
    views = len(seen.weights)
    if views < 3:
        return []
    rays = rays_of(rig, seen.images)  # (K, 3, M)
    centres = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    starts = []
    for j, k in combinations(range(views), 2):
        both = (seen.weights[j] > 0) & (seen.weights[k] > 0)
        baseline = (centres[k] - centres[j])[:, None]
        cosine = (rays[j] * rays[k]).sum(0)
        sine = 1 - np.square(cosine)
        first, second = (baseline * rays[j]).sum(0), (baseline * rays[k]).sum(0)
        safe = np.where(both & (sine > PARALLEL), sine, np.nan)
        along_j = (first - cosine * second) / safe
        along_k = (cosine * first - second) / safe
        ends = centres[j][:, None] + along_j * rays[j] + centres[k][:, None] + along_k * rays[k]
        starts.append(ends / 2)
    return starts
