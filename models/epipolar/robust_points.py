"""Triangulation under Student's t: some rays of a point may be wrong.

Every pair of rays and all rays together give a start for each point; the most likely one is
improved by Gauss-Newton steps (Hartley & Zisserman, *Multiple View Geometry*, ch. 12, with the
reweighting of Triggs et al., *Bundle adjustment: a modern synthesis*, 1999).
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.epipolar.static_cameras import (
    BLIND,
    FREEDOM,
    SeenPoints,
    Sight,
    StaticCameras,
    differentiate_image,
    distance_in,
    image_of,
    rays_of,
    sight_of,
)
from models.numerics.compiled import compiled
from models.numerics.matrices import cholesky, cholesky_solve, fill

Float64 = NDArray[np.float64]

ITERATIONS = 8
PARALLEL = 1e-8  # squared sine of the angle below which two rays count as parallel
LEAST_ANGLE = 1e-4  # radians between a ray and a point, below which all rays count alike
POINT_DAMPING = 1e-4
TINY = 1e-12  # of a point's curvature: what keeps parallel rays solvable
SETTLED = 1e-3  # nats of all points together: a step of all that gains less is the last
POINT_STEPS = 1  # of each point by itself, after a step of all


def robust_points(
    rig: StaticCameras, seen: SeenPoints, noise: Float64, *, start: Float64 | None = None
) -> Float64:
    """Return the most likely points (3, M) from K cameras, with two rays or more each.

    `noise` (K,) is the scale of Student's t in sides of the image, `start` (3, M) another guess.
    """
    points = triangulate_points(rig, seen)
    costs = costs_of(rig, points, seen, noise)
    for guess in [*([] if start is None else [start]), *_of_pairs(rig, seen)]:
        tried = costs_of(rig, guess, seen, noise)
        better = np.isfinite(guess).all(0) & (tried < costs)
        points, costs = np.where(better, guess, points), np.where(better, tried, costs)
    return settle_points(rig, points, seen, noise, steps=ITERATIONS)[0]


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
) -> tuple[Float64, Float64]:
    """Improve points (3, M) with fixed cameras, by Gauss-Newton steps that lower the cost.

    Returns also the costs (M,) of the points, as `costs_of` does.
    """
    sight = sight_of(rig, points, seen)
    costs, tried_costs = np.empty(points.shape[1]), np.empty(points.shape[1])
    _write_costs(sight, noise, costs)
    damping = np.full(points.shape[1], POINT_DAMPING)
    for step in range(steps):
        if step:
            sight = sight_of(rig, points, seen)
        tried = np.empty(points.shape)
        _step(sight, noise, damping, tried)
        tried_sight = sight_of(rig, tried, seen)
        _write_costs(tried_sight, noise, tried_costs)
        better = tried_costs <= costs
        gained = (costs - tried_costs)[better].sum()
        points, costs = np.where(better, tried, points), np.where(better, tried_costs, costs)
        if better.all() and gained < SETTLED:
            break
        damping = np.where(better, damping / 10, damping * 10)
    return points, costs


def costs_of(rig: StaticCameras, points: Float64, seen: SeenPoints, noise: Float64) -> Float64:
    """Return minus the log likelihood (M,) of all rays of each point under Student's t."""
    costs = np.empty(points.shape[1])
    _write_costs(sight_of(rig, points, seen), noise, costs)
    return costs


@compiled
def _write_costs(sight: Sight, noise: Float64, out: Float64) -> None:
    views, seen = len(noise), np.empty(5)
    logs = 2 * np.log(noise)
    for m in range(len(out)):
        out[m] = 0.0
        for k in range(views):
            weight = sight.weights[k, m]
            if weight > 0:
                visible = image_of(sight, k, m, seen)
                distance = distance_in(sight, k, m, seen) if visible else BLIND
                squared = (distance / noise[k]) ** 2
                robust = (FREEDOM + 2) / 2 * np.log1p(squared / FREEDOM)
                out[m] += weight * (robust + logs[k])


@compiled
def _step(sight: Sight, noise: Float64, damping: Float64, out: Float64) -> None:
    """Write the points after one damped step of each."""
    views, count = sight.weights.shape
    seen, by_held, by_point = np.empty(5), np.empty((2, 3)), np.empty((2, 3))
    normal, right = np.empty((3, 3)), np.empty(3)
    for m in range(count):
        fill(normal, 0.0)
        fill(right, 0.0)
        for k in range(views):
            weight = sight.weights[k, m]
            if weight <= 0 or not image_of(sight, k, m, seen):
                continue
            differentiate_image(sight, k, seen, by_held, by_point)
            across, down = seen[0] - sight.images[k, 0, m], seen[1] - sight.images[k, 1, m]
            squared = (across * across + down * down) / noise[k] ** 2
            weight *= (FREEDOM + 2) / (FREEDOM + squared) / noise[k] ** 2
            for a in range(3):
                right[a] -= weight * (by_point[0, a] * across + by_point[1, a] * down)
                for b in range(a + 1):
                    normal[a, b] += weight * (
                        by_point[0, a] * by_point[0, b] + by_point[1, a] * by_point[1, b]
                    )
        least = TINY * (max(normal[0, 0], normal[1, 1], normal[2, 2]) + 1.0)
        for a in range(3):
            normal[a, a] += damping[m] * normal[a, a] + least
        if cholesky(normal):
            cholesky_solve(normal, right)
        else:
            fill(right, 0.0)
        for a in range(3):
            out[a, m] = sight.points[a, m] + right[a]
