"""Triangulation under Student's t: points of which one ray or another may be wrong.

Every pair of rays and all rays together give a start for each point; the most likely one is
improved by Gauss-Newton steps (Hartley & Zisserman, *Multiple View Geometry*, ch. 12, with the
reweighting of Triggs et al., *Bundle adjustment: a modern synthesis*, 1999).
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.epipolar.rig_adjustment import (
    Rigid,
    Seen,
    distances_of,
    rays_of,
    robust_costs,
    settle_points,
    triangulate_points,
)

Float64 = NDArray[np.float64]

ITERATIONS = 8
PARALLEL = 1e-8  # squared sine of the angle between two rays that meet nowhere


def robust_points(
    rig: Rigid, seen: Seen, noise: Float64, *, start: Float64 | None = None
) -> Float64:
    """Return the most likely points (3, M) of what K cameras see; two rays or more of each.

    `noise` (K,) is the scale of Student's t in sides of the image, `start` (3, M) another guess.
    """

    def costs_of(points: Float64) -> Float64:
        distances = distances_of(rig, points, seen)
        costs: Float64 = robust_costs(distances, seen.weights, noise).sum(0)
        return costs

    points = triangulate_points(rig, seen)
    costs = costs_of(points)
    for guess in [*([] if start is None else [start]), *_of_pairs(rig, seen)]:
        tried = costs_of(guess)
        better = np.isfinite(guess).all(0) & (tried < costs)
        points, costs = np.where(better, guess, points), np.where(better, tried, costs)
    return settle_points(rig, points, seen, noise, steps=ITERATIONS)


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
