"""Triangulation under Student's t: some rays of a point may be wrong.

All rays together give a start for each point, and every pair of rays where one is far from it. The
most likely one is improved by Gauss-Newton steps (Hartley & Zisserman, *Multiple View Geometry*,
ch. 12, with the reweighting of Triggs et al., *Bundle adjustment: a modern synthesis*, 1999).
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
    distances_of,
    image_of,
    rays_of,
    sight_of,
)
from models.numerics.compiled import compiled
from models.numerics.matrices import cholesky, cholesky_solve, fill, inverse_symmetric
from models.numerics.sampling import evenly_spread
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ITERATIONS = 8
AGREEING = (
    3.0  # scales of the noise: where all rays of a point are nearer, no two give a better one
)
MOST_PAIRS = 15  # of views: one of them has good rays, and the time does not grow with the square
PARALLEL = 1e-8  # squared sine of the angle below which two rays count as parallel
LEAST_ANGLE = 1e-4  # radians between a ray and a point, below which all rays count alike
POINT_DAMPING = 1e-4
TINY_RAYS = 1e-9  # of a point's curvature: what keeps parallel rays solvable
SETTLED = 1e-3  # nats of all points together: a step of all that gains less is the last
POINT_STEPS = 1  # of each point by itself, after a step of all


def robust_points(
    rig: StaticCameras, seen: SeenPoints, noise: Float64, *, start: Float64 | None = None
) -> Float64:
    """Return the most likely points (3, M) from K cameras, with two rays or more each.

    `noise` (K,) is the scale of Student's t in sides of the image, `start` (3, M) another guess.
    """
    points = triangulate_points(rig, seen)
    if start is not None:
        better = np.isfinite(start).all(0) & (
            costs_of(rig, start, seen, noise) < costs_of(rig, points, seen, noise)
        )
        points = np.where(better, start, points)
    distances = distances_of(rig, points, seen)
    far = (distances > AGREEING * noise[:, None]) & (seen.weights > 0)
    doubtful: Bool = np.any(far, axis=0)
    points[:, doubtful] = _likeliest(rig, points, seen, noise, doubtful)
    return settle_points(rig, points, seen, noise, steps=ITERATIONS)[0]


def _likeliest(
    rig: StaticCameras, points: Float64, seen: SeenPoints, noise: Float64, some: Bool
) -> Float64:
    """Return the likeliest of the points `some` (M,) and of those that any two rays give."""
    part = SeenPoints(*map(np.ascontiguousarray, (seen.images[..., some], seen.weights[:, some])))
    sight = sight_of(rig, points, seen)  # depths are usual among all points
    best, costs = points[:, some], np.full(int(some.sum()), np.inf)
    tried = np.empty(len(costs))
    for guess in (best, *_of_pairs(rig, part)):
        shown = np.ascontiguousarray(guess)
        _write_costs(Sight(sight.cameras, sight.depths, shown, *part), noise, tried)
        better = np.isfinite(guess).all(0) & (tried < costs)
        best, costs = np.where(better, guess, best), np.where(better, tried, costs)
    return best


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
    """Points (3, M) midway between the rays of two views, for many pairs; NaN where there are not.

    With two views all rays are these two, and the list is empty.
    """
    views = len(seen.weights)
    if views < 3:
        return []
    rays = rays_of(rig, seen.images)  # (K, 3, M)
    centres = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    starts = []
    pairs = list(combinations(range(views), 2))
    for j, k in (pairs[place] for place in evenly_spread(len(pairs), MOST_PAIRS)):
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
    rays = np.ascontiguousarray(rays_of(rig, seen.images))  # (K, 3, M) in the rig's frame
    centres = -np.einsum("kji,kj->ki", rig.rotations, rig.translations)
    weights, there = seen.weights.copy(), seen.weights > 0
    judged = there & (there.sum(0) > 2)
    points, angles = np.empty((3, weights.shape[1])), np.empty(weights.shape)
    for _ in range(rounds):
        _meet(rays, centres, weights, points, angles)
        if not judged.any():
            break
        scale = max(float(np.median(angles[judged])), LEAST_ANGLE)
        weights = seen.weights / (1 + np.square(angles / scale) / FREEDOM)
    return points


@compiled
def _meet(rays: Float64, centres: Float64, weights: Float64, points: Float64, off: Float64) -> None:
    """Write the points (3, M) nearest to weighted rays, and angles (K, M) of rays off them."""
    views, count = weights.shape
    normal, right, whole = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for m in range(count):
        fill(normal, 0.0)
        fill(right, 0.0)
        for k in range(views):
            for a in range(3):
                for b in range(3):
                    across = weights[k, m] * ((a == b) - rays[k, a, m] * rays[k, b, m])
                    normal[a, b] += across
                    right[a] += across * centres[k, b]
        least = TINY_RAYS * (1.0 + normal[0, 0] + normal[1, 1] + normal[2, 2])
        inverse_symmetric(normal, least, whole)
        for a in range(3):
            points[a, m] = whole[a, 0] * right[0] + whole[a, 1] * right[1] + whole[a, 2] * right[2]
        for k in range(views):
            along, squared = 0.0, 0.0
            for a in range(3):
                offset = points[a, m] - centres[k, a]
                along += offset * rays[k, a, m]
                squared += offset * offset
            distance = max(np.sqrt(squared), 1e-9)
            off[k, m] = np.sqrt(max(squared - along * along, 0.0)) / distance


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
