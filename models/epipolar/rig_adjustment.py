"""Robust bundle adjustment of points and static cameras, without shapes or bones.

Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern synthesis*, 1999:
Levenberg-Marquardt with the points eliminated (Schur complement), Student's t by reweighting.
Coordinates of the images are pixels from the expected principal point in sides of the image; the
unit of the points is free. Points come last in all arrays, so that everything runs along them.
"""

from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.robust_points import costs_of, settle_points
from models.epipolar.static_cameras import (
    CAMERA,
    LENS,
    SeenPoints,
    Sight,
    StaticCameras,
    differentiate_image,
    image_of,
    linearised,
    sight_of,
)
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import fill, inverse_symmetric
from models.numerics.medians import RAYLEIGH
from models.numerics.rotations import rotations_from_vectors
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

# Figures: evidence/static-rigs.md.
LEAST_NOISE = 1e-5  # sides: less is as good as none
LEAST_LEFT = 0.1  # least share of a view's residuals that points do not absorb
POOLED = 2 / 3  # share of the common noise in the log of each view's
ALIKE = 0.02  # scale of Cauchy's distribution of the log ratio of focal lengths
LOG_WALLS = np.log((0.3, 4.5))  # limits of focal lengths, as factors of the expected one
WALL_SD = 0.05
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-12, 1e8
LESS_DAMPING, MORE_DAMPING = 10.0, 8.0  # after a step that gained, and one that did not
DAMPED_NO_MORE = 1e-8
LEAST_HELD = 1e-12  # share of its curvature that holds each number
CONVERGED, STILL = 0.02, 2  # nats, in so many steps
LEARN_NOISE = 4  # steps, after which the noise is measured anew


class AdjustedRig(NamedTuple):
    """The outcome of `adjust_rig`."""

    rig: StaticCameras
    points: Float64  # (3, M)
    noise: Float64  # (K,) sides, of each view


def adjust_rig(
    rig: StaticCameras,
    points: Float64,
    seen: SeenPoints,
    beliefs: Beliefs,
    *,
    iterations: int,
    lenses: bool = True,
    least_noise: float = LEAST_NOISE,
) -> AdjustedRig:
    """Adjust cameras and points (3, M); without `lenses`, only the focal lengths of these are free.

    The noise of each view is estimated from its median distance on the way. With `least_noise` (in
    sides) as its lower limit, a start is less likely to end in a wrong minimum.
    """
    free = free_numbers(rig, beliefs, lenses=lenses)
    noise = noise_of(rig, points, seen, least_noise)
    damping, still = FIRST_DAMPING, 0
    cost = cost_of(rig, points, seen, noise, beliefs)
    for iteration in range(iterations):
        if iteration and iteration % LEARN_NOISE == 0:
            noise = noise_of(rig, points, seen, least_noise)
            cost = cost_of(rig, points, seen, noise, beliefs)
        tried_rig, tried = _step(rig, points, seen, noise, beliefs, free, damping)
        tried, costs = settle_points(tried_rig, tried, seen, noise)
        tried_cost = float(costs.sum()) + lens_cost(tried_rig, beliefs) / 2
        if tried_cost <= cost:
            gained = cost - tried_cost
            rig, points, cost = tried_rig, tried, tried_cost
            damping = max(damping / LESS_DAMPING, LEAST_DAMPING)
            # Along a narrow valley a damped step gains little, however far the end is.
            still = still + 1 if gained < CONVERGED and damping <= DAMPED_NO_MORE else 0
            if still >= STILL:
                break
        else:
            damping *= MORE_DAMPING
            if damping > MOST_DAMPING:
                break
    return AdjustedRig(rig, points, noise_of(rig, points, seen, least_noise))


def noise_of(rig: StaticCameras, points: Float64, seen: SeenPoints, least: float) -> Float64:
    """Estimate the noise (K,) of a coordinate in each view, pooled with that of all views.

    It is the median residual divided by the share of a view's residuals that the points leave. The
    more a view decides where the points are, the more of its residuals they absorb.
    """
    there = seen.weights > 0
    lengths, leverages = np.zeros(there.shape), np.zeros(there.shape)
    _write_leverages(sight_of(rig, points, seen), lengths, leverages)
    left = np.array([1 - row[w].mean() / 2 for row, w in zip(leverages, there, strict=True)])
    left = left.clip(LEAST_LEFT)
    medians = np.array([np.median(row[w]) for row, w in zip(lengths, there, strict=True)])
    noise = (medians / RAYLEIGH / np.sqrt(left)).clip(least)
    common = np.exp(float((left * np.log(noise)).sum() / left.sum()))
    if len(noise) == 2:
        return np.full(2, common)
    return np.asarray(common**POOLED * noise ** (1 - POOLED))


@compiled
def _write_leverages(sight: Sight, lengths: Float64, leverages: Float64) -> None:
    """Write lengths (K, M) of residuals and their leverages, of 2 numbers each, on the points."""
    views, count = lengths.shape
    seen, by_held, by_point = np.empty(5), np.empty((2, 3)), np.empty((views, 2, 3))
    normal, solved = np.empty((3, 3)), np.empty((3, 3))
    for m in range(count):
        fill(normal, 0.0)
        fill(by_point, 0.0)
        for k in range(views):
            if sight.weights[k, m] <= 0 or not image_of(sight, k, m, seen):
                continue
            across, down = seen[0] - sight.images[k, 0, m], seen[1] - sight.images[k, 1, m]
            lengths[k, m] = np.sqrt(across * across + down * down)
            differentiate_image(sight, k, seen, by_held, by_point[k])
            for a in range(3):
                for b in range(a, 3):
                    normal[a, b] += _dot(by_point[k], by_point[k], a, b)
        inverse_symmetric(normal, TINY * (normal[0, 0] + normal[1, 1] + normal[2, 2] + 1), solved)
        for k in range(views):
            for a in range(3):
                for b in range(3):
                    leverages[k, m] += solved[a, b] * _dot(by_point[k], by_point[k], a, b)


@inner
def _dot(first: Float64, other: Float64, a: int, b: int) -> float:
    """Multiply column a of a matrix of two rows by column b of another."""
    return float(first[0, a] * other[0, b] + first[1, a] * other[1, b])


class _Prior(NamedTuple):
    """The cost of the lenses as a quadratic about their values."""

    gradient: Float64  # (K, 5) half that of the cost
    precision: Float64  # (K, 5, K, 5)


def lens_cost(rig: StaticCameras, beliefs: Beliefs) -> float:
    """Return minus twice the log density of the lenses under their prior."""
    offsets, beyond = _lens_offsets(rig, beliefs)
    cost = (offsets * (beliefs.precisions @ offsets[..., None])[..., 0]).sum()
    cost += np.square(beyond / WALL_SD).sum()
    if beliefs.alike:
        cost += 2 * np.log1p(np.square(_unlikeness(rig.log_focals))).sum()
    return float(cost)


def lens_prior(rig: StaticCameras, beliefs: Beliefs) -> _Prior:
    """Return the derivatives of `lens_cost`."""
    views = len(rig.log_focals)
    offsets, beyond = _lens_offsets(rig, beliefs)
    blocks = beliefs.precisions.copy()
    gradient = (blocks @ offsets[..., None])[..., 0].T
    gradient[:, 0] += beyond / WALL_SD**2
    blocks[0] += np.diag((beyond != 0) / WALL_SD**2)
    if beliefs.alike:
        weights = 2 / (1 + np.square(_unlikeness(rig.log_focals))) / ALIKE**2
        centring = np.eye(views) - weights / weights.sum()
        together = centring.T @ np.diag(weights) @ centring
        blocks[0] += together
        gradient[:, 0] += together @ rig.log_focals
    precision = np.zeros((views, LENS, views, LENS))
    for number in range(LENS):
        precision[:, number, :, number] = blocks[number]
    return _Prior(gradient, precision)


def _lens_offsets(rig: StaticCameras, beliefs: Beliefs) -> tuple[Float64, Float64]:
    """Return offsets (5, K) from the prior's mean, and of focal lengths (K,) beyond the walls."""
    offsets = np.stack((rig.log_focals - np.log(beliefs.focals), *rig.centres.T, *rig.radial.T))
    low, high = LOG_WALLS
    return offsets, (offsets[0] - high).clip(0) + (offsets[0] - low).clip(max=0)


def _unlikeness(log_focals: Float64) -> Float64:
    """Return offsets (K,) from the median; focal lengths are often alike (Cauchy's distribution).

    They are in units of the scale of that distribution.
    """
    return np.asarray((log_focals - median(log_focals.tolist())) / ALIKE, np.float64)


def cost_of(
    rig: StaticCameras, points: Float64, seen: SeenPoints, noise: Float64, beliefs: Beliefs
) -> float:
    """Return minus the log posterior of cameras and points (3, M), under a noise (K,) in sides."""
    return float(costs_of(rig, points, seen, noise).sum()) + lens_cost(rig, beliefs) / 2


def free_numbers(rig: StaticCameras, beliefs: Beliefs, *, lenses: bool) -> Bool:
    """Which of the cameras' numbers (K, 11) may change; the first camera's pose is the frame."""
    free = np.ones((len(rig.log_focals), CAMERA), bool)
    free[:, 0] = beliefs.focal_sds > 0
    free[:, 1:3] = (beliefs.centre_covariance.diagonal()[:, None] > 0) & lenses
    bends = beliefs.radial_covariance.diagonal(axis1=1, axis2=2).T > 0  # (K, 2)
    free[:, 3:LENS] = bends & lenses
    free[0, LENS:] = False
    return free


class CameraEquations(NamedTuple):
    """The normal equations of the cameras, the points eliminated."""

    scores: Float64  # (11 K, M) what each point adds to the vector, besides the prior
    information: Float64  # (11 K, 11 K) of cameras and points
    vector: Float64  # (11 K,) of the cameras alone
    cross: Float64  # (11 K, 3 M) of cameras and points
    spread: Float64  # (11 K, 3 M) derivative of the points by the cameras' numbers
    solved: Float64  # (3, M) the points' own step

    def matrix(self, places: Int64) -> Float64:
        """Return the matrix (n, n) of some of the cameras' numbers alone."""
        reduced = self.spread[places] @ self.cross[places].T
        return np.asarray(self.information[np.ix_(places, places)] - reduced)


def reduced_equations(
    rig: StaticCameras,
    points: Float64,
    seen: SeenPoints,
    noise: Float64,
    beliefs: Beliefs,
    damping: float,
) -> CameraEquations:
    """Return the normal equations of the cameras about a rig and its points (3, M)."""
    views = len(seen.weights)
    residuals, by_camera, by_point = linearised(rig, points, seen, noise)
    solved, scores, cross, spread = without_points(residuals, by_camera, by_point, damping)
    size = views * CAMERA
    rows = by_camera.transpose(0, 2, 1, 3).reshape(views, CAMERA, -1)
    information = np.zeros((views, CAMERA, views, CAMERA))
    information[range(views), :, range(views), :] = rows @ rows.mT
    prior = lens_prior(rig, beliefs)
    information[:, :LENS, :, :LENS] += prior.precision
    whole, vector = information.reshape(size, size), scores.sum(1)
    vector.reshape(views, CAMERA)[:, :LENS] -= prior.gradient
    return CameraEquations(scores, whole, vector, cross, spread, solved)


def without_points(
    residuals: Float64, by_camera: Float64, by_point: Float64, damping: float
) -> tuple[Float64, Float64, Float64, Float64]:
    """Eliminate the points from residuals (K, 2, M) and derivatives (K, 2, C, M), (K, 2, 3, M).

    Returns the points' own step (3, M), scores (C K, M), cross and spread (C K, 3 M), as in
    `CameraEquations`.
    """
    size, count = by_camera.shape[0] * by_camera.shape[2], residuals.shape[2]
    inverse, solved = np.empty((3, 3, count)), np.empty((3, count))
    _solve_points(residuals, by_point, damping, inverse, solved)
    scores, cross, spread = (np.empty((size, *shape, count)) for shape in ((), (3,), (3,)))
    _eliminate_points(residuals, by_camera, by_point, inverse, solved, scores, cross, spread)
    return solved, scores, cross.reshape(size, -1), spread.reshape(size, -1)


@compiled
def _solve_points(
    residuals: Float64, by_point: Float64, damping: float, inverse: Float64, solved: Float64
) -> None:
    """Write each point's inverse normal matrix (3, 3, M) and own step (3, M)."""
    views, count = len(residuals), residuals.shape[2]
    normal, toward, own = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for m in range(count):
        fill(normal, 0.0)
        fill(toward, 0.0)
        for k in range(views):
            for i in range(2):
                for a in range(3):
                    toward[a] -= by_point[k, i, a, m] * residuals[k, i, m]
                    for b in range(a, 3):
                        normal[a, b] += by_point[k, i, a, m] * by_point[k, i, b, m]
        least = 1e-9 * (normal[0, 0] + normal[1, 1] + normal[2, 2]) / 3 + 1e-12
        for a in range(3):
            normal[a, a] *= 1.0 + damping
        inverse_symmetric(normal, least, own)
        for a in range(3):
            solved[a, m] = own[a, 0] * toward[0] + own[a, 1] * toward[1] + own[a, 2] * toward[2]
            for b in range(3):
                inverse[a, b, m] = own[a, b]


@compiled
def _eliminate_points(
    residuals: Float64,
    by_camera: Float64,
    by_point: Float64,
    inverse: Float64,
    solved: Float64,
    scores: Float64,
    cross: Float64,
    spread: Float64,
) -> None:
    """Write scores (C K, M), and products (C K, 3, M) of derivatives without and with inverses.

    The innermost loops run along the points, where arrays are contiguous.
    """
    views, numbers, count = len(residuals), by_camera.shape[2], residuals.shape[2]
    for k in range(views):
        for c in range(numbers):
            row = k * numbers + c
            for m in range(count):
                first, other = by_camera[k, 0, c, m], by_camera[k, 1, c, m]
                x = first * by_point[k, 0, 0, m] + other * by_point[k, 1, 0, m]
                y = first * by_point[k, 0, 1, m] + other * by_point[k, 1, 1, m]
                z = first * by_point[k, 0, 2, m] + other * by_point[k, 1, 2, m]
                cross[row, 0, m], cross[row, 1, m], cross[row, 2, m] = x, y, z
                pull = -first * residuals[k, 0, m] - other * residuals[k, 1, m]
                scores[row, m] = pull - x * solved[0, m] - y * solved[1, m] - z * solved[2, m]
                for a in range(3):
                    spread[row, a, m] = (
                        x * inverse[a, 0, m] + y * inverse[a, 1, m] + z * inverse[a, 2, m]
                    )


def _step(
    rig: StaticCameras,
    points: Float64,
    seen: SeenPoints,
    noise: Float64,
    beliefs: Beliefs,
    free: Bool,
    damping: float,
) -> tuple[StaticCameras, Float64]:
    """Take one damped step of Gauss and Newton, the points eliminated."""
    equations = reduced_equations(rig, points, seen, noise, beliefs, damping)
    places = np.flatnonzero(free)
    matrix = equations.matrix(places)
    root = np.sqrt(equations.information.diagonal()[places])
    root = np.where(root > 0, root, 1.0)
    held = matrix / root / root[:, None] + (damping + LEAST_HELD) * np.eye(len(places))
    step = np.zeros(free.size)
    step[places] = np.linalg.solve(held, equations.vector[places] / root) / root
    moved = equations.solved - (step[places] @ equations.spread[places]).reshape(points.shape)
    return _moved(rig, step.reshape(free.shape)), points + moved


def _moved(rig: StaticCameras, step: Float64) -> StaticCameras:
    return StaticCameras(
        rig.log_focals + step[:, 0].clip(-0.3, 0.3),
        rig.centres + step[:, 1:3],
        (rig.radial + step[:, 3:LENS]).clip(-2, 2),
        rotations_from_vectors(step[:, LENS : LENS + 3]) @ rig.rotations,
        rig.translations + step[:, LENS + 3 :],
    )
