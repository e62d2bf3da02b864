"""Triangulation under Student's t: some rays of a point may be wrong.

Every pair of rays and all rays together give a start for each point; the most likely one is
improved by Gauss-Newton steps (Hartley & Zisserman, *Multiple View Geometry*, ch. 12, with the
reweighting of Triggs et al., *Bundle adjustment: a modern synthesis*, 1999).
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.epipolar.static_cameras import (
    FREEDOM,
    SeenPoints,
    StaticCameras,
    distances_of,
    rays_of,
    residuals_by_points,
    robust_costs,
)

Float64 = NDArray[np.float64]

ITERATIONS = 8
PARALLEL = 1e-8  # squared sine of the angle below which two rays count as parallel
LEAST_ANGLE = 1e-4  # radians between a ray and a point, below which all rays count alike
POINT_DAMPING = 1e-4
TINY = 1e-12  # of a point's curvature: what keeps parallel rays solvable
POINT_STEPS = 1  # of each point by itself, after a step of all


def robust_points(
    rig: StaticCameras, seen: SeenPoints, noise: Float64, *, start: Float64 | None = None
) -> Float64:
    """Return the most likely points (3, M) from K cameras, with two rays or more each.

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


def robust_structures(
    rig: StaticCameras, images: Float64, weights: Float64, noise: Float64
) -> Float64:
    """Return points (N, P, 3) of images (N, K, P, 2) with weights (N, K, P).

    NaN where fewer than two cameras see one; `noise` as in `robust_points`.
    """
    frames, views, count, _ = images.shape
    every = SeenPoints(
        images.transpose(1, 3, 0, 2).reshape(views, 2, -1),
        weights.transpose(1, 0, 2).reshape(views, -1),
    )
    known = np.flatnonzero((every.weights > 0).sum(0) >= 2)
    points = np.full((frames * count, 3), np.nan)
    some = SeenPoints(every.images[..., known], every.weights[:, known])
    points[known] = robust_points(rig, some, noise).T
    return points.reshape(frames, count, 3)


def _of_pairs(rig: StaticCameras, seen: SeenPoints) -> list[Float64]:
    """Points (3, M) midway between the rays of two views, for every two; NaN where there are not.

    With two views all rays are these two, and the list is empty.
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


def triangulate_points(rig: StaticCameras, seen: SeenPoints, *, rounds: int = 4) -> Float64:
    """Return the points (3, M) nearest to their rays; distant rays lose weight step by step."""
    rays = rays_of(rig, seen.images)  # (K, 3, M) in the rig's frame
    across = np.eye(3)[None, :, :, None] - rays[:, :, None] * rays[:, None]  # (K, 3, 3, M)
    centres = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    anchors = np.einsum("kijm,kj->kim", across, centres)
    weights = seen.weights.copy()
    several = seen.weights.astype(bool).sum(0) > 2
    points = np.zeros((3, seen.weights.shape[1]))
    for _ in range(rounds):
        normal = np.einsum("km,kijm->mij", weights, across, optimize=True)
        normal += 1e-9 * np.eye(3) * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None]
        target = np.einsum("km,kim->mi", weights, anchors)
        points = np.linalg.solve(normal, target[..., None])[..., 0].T
        offsets = points[None] - centres[..., None]
        distances = np.linalg.norm(np.einsum("kijm,kjm->kim", across, offsets), axis=1)
        angles = distances / np.linalg.norm(offsets, axis=1).clip(1e-9)
        there = seen.weights > 0
        if not (there & several).any():
            break
        scale = max(float(np.median(angles[there & several])), LEAST_ANGLE)
        weights = seen.weights / (1 + np.square(angles / scale) / FREEDOM)
    return points


def settle_points(
    rig: StaticCameras,
    points: Float64,
    seen: SeenPoints,
    noise: Float64,
    *,
    steps: int = POINT_STEPS,
) -> Float64:
    """Improve points (3, M) with fixed cameras, by Gauss-Newton steps that lower the cost."""

    def costs_of(points: Float64) -> Float64:
        distances = distances_of(rig, points, seen)
        costs: Float64 = robust_costs(distances, seen.weights, noise).sum(0)
        return costs

    costs = costs_of(points)
    damping = np.full(points.shape[1], POINT_DAMPING)
    for _ in range(steps):
        residuals, by_point = residuals_by_points(rig, points, seen)
        squared = np.square(residuals).sum(1) / np.square(noise)[:, None]
        weights = seen.weights * (FREEDOM + 2) / (FREEDOM + squared) / np.square(noise)[:, None]
        weighted = by_point * weights[:, None, None]
        normal = np.einsum("kiam,kibm->mab", weighted, by_point, optimize=True)
        right = -np.einsum("kiam,kim->ma", weighted, residuals, optimize=True)
        diagonal = normal[:, range(3), range(3)]
        least = TINY * (diagonal.max(1, keepdims=True) + 1)
        normal[:, range(3), range(3)] += damping[:, None] * diagonal + least
        tried_points = points + np.linalg.solve(normal, right[..., None])[..., 0].T
        tried = costs_of(tried_points)
        better = tried <= costs
        points, costs = np.where(better, tried_points, points), np.where(better, tried, costs)
        damping = np.where(better, damping / 10, damping * 10)
    return points
