"""Robust bundle adjustment of points and cameras at rest, without shapes or bones.

Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle adjustment: a modern synthesis*, 1999:
Levenberg-Marquardt with the points eliminated (Schur complement), Student's t by reweighting.
Coordinates of the images are pixels from the expected principal point in sides of the image; the
unit of the points is free. Points come last in all arrays, so that everything runs along them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

CAMERA = 11  # numbers: log focal, principal point, radial coefficients, rotation, translation
LENS = 5
FREEDOM = 3.0  # of Student's t
RAYLEIGH = 1.1774  # median length of a pair of unit normal numbers
LEAST_NOISE = 1e-5  # sides: less cannot be told from none
LEAST_ANGLE = 1e-4  # radians between a ray and a point, below which all rays count alike
LEAST_LEFT = 0.1  # share of a view's numbers that points do not take up
POOLED = 2 / 3  # share of the common noise in the log of each view's
NEAR, FAR = 0.2, 5.0  # median depths between which a point has a say
BLIND = 1.0  # sides that stand for a point that a camera cannot see there: none is further off
ALIKE = 0.02  # scale of Cauchy's distribution of the log ratio of focal lengths
LOG_WALLS = np.log((0.3, 4.5))  # factors of the expected focal length that no lens goes beyond
WALL_SD = 0.05
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-12, 1e8
LESS_DAMPING, MORE_DAMPING = 10.0, 8.0  # after a step that gained, and one that did not
DAMPED_NO_MORE = 1e-8
LEAST_HELD = 1e-12  # share of its curvature that holds each number
CONVERGED, STILL = 0.02, 2  # nats, in so many steps
POINT_DAMPING = 1e-4
TINY = 1e-12  # of a point's curvature: what keeps parallel rays solvable
LEARN_NOISE = 4  # steps, after which the noise is measured anew
POINT_STEPS = 1  # of each point by itself, after a step of all


class Rigid(NamedTuple):
    """K cameras at rest, x = R X + t, and their lenses in sides of the image."""

    log_focals: Float64  # (K,)
    centres: Float64  # (K, 2) from the expected principal points
    radial: Float64  # (K, 2) first two radial coefficients
    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)

    def of(self, views: list[int]) -> "Rigid":
        """Return some of the cameras."""
        return Rigid(*(array[views] for array in self))


class Seen(NamedTuple):
    """What K cameras see of M points."""

    images: Float64  # (K, 2, M), any finite number where the weight is 0
    weights: Float64  # (K, M) confidences


class Adjusted(NamedTuple):
    """The outcome of `adjust_rig`."""

    rig: Rigid
    points: Float64  # (3, M)
    noise: Float64  # (K,) sides, of each view


def triangulate_points(rig: Rigid, seen: Seen, *, rounds: int = 4) -> Float64:
    """Return the points (3, M) next to their rays, those far off having less and less of a say."""
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


def images_of(rig: Rigid, points: Float64, seen: Seen) -> tuple[Float64, Bool]:
    """Return images (K, 2, M) of points (3, M), and whether (K, M) a camera can see them there."""
    flat, visible = _flat(rig.rotations @ points + rig.translations[..., None], seen)
    return _images(rig, flat)[0], visible


def distances_of(rig: Rigid, points: Float64, seen: Seen) -> Float64:
    """Sides (K, M) from what is seen to the points' images; `BLIND` where a camera cannot see."""
    images, visible = images_of(rig, points, seen)
    lengths = np.linalg.norm(images - seen.images, axis=1)
    distances: Float64 = np.where(visible, np.minimum(lengths, BLIND), BLIND)
    return distances


def robust_costs(distances: Float64, weights: Float64, noise: Float64) -> Float64:
    """Minus log likelihood (K, M) of distances (K, M) under Student's t of `noise` (K,)."""
    squared = np.square(distances / noise[:, None]) / FREEDOM
    costs: Float64 = weights * ((FREEDOM + 2) / 2 * np.log1p(squared) + 2 * np.log(noise)[:, None])
    return costs


def prior_cost(rig: Rigid, beliefs: Beliefs) -> float:
    """Minus log density of the lenses, up to a constant."""
    return 0.5 * float(lens_prior(rig, beliefs).cost)


def adjust_rig(
    rig: Rigid,
    points: Float64,
    seen: Seen,
    beliefs: Beliefs,
    *,
    iterations: int,
    lenses: bool = True,
    least_noise: float = LEAST_NOISE,
) -> Adjusted:
    """Adjust cameras and points (3, M); without `lenses`, only focal lengths are free of these.

    The noise of each view is learnt from its median distance on the way; a start is less easily
    caught by a wrong minimum if no noise below `least_noise` in sides is believed.
    """
    free = free_numbers(rig, beliefs, lenses=lenses)
    noise = noise_of(rig, points, seen, least_noise)
    damping, still = FIRST_DAMPING, 0
    cost = _cost(rig, points, seen, noise, beliefs)
    for iteration in range(iterations):
        if iteration and iteration % LEARN_NOISE == 0:
            noise = noise_of(rig, points, seen, least_noise)
            cost = _cost(rig, points, seen, noise, beliefs)
        tried_rig, tried = _step(rig, points, seen, noise, beliefs, free, damping)
        tried = settle_points(tried_rig, tried, seen, noise)
        tried_cost = _cost(tried_rig, tried, seen, noise, beliefs)
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
    return Adjusted(rig, points, noise_of(rig, points, seen, least_noise))


def noise_of(rig: Rigid, points: Float64, seen: Seen, least: float) -> Float64:
    """Noise (K,) of a coordinate in each view, for the most part what views share.

    By medians, as a share of residuals that points leave: of what they were made of they take up
    the more, the more a view has a say in where they are.
    """
    there = seen.weights > 0
    residuals, by_point = residuals_by_points(rig, points, seen)
    of_views = np.einsum("kiam,kibm->kmab", by_point, by_point, optimize=True)
    normal = of_views.sum(0)
    normal[:, range(3), range(3)] += TINY * (np.trace(normal, axis1=1, axis2=2) + 1)[:, None]
    leverages = (np.linalg.inv(normal) * of_views).sum((2, 3))  # (K, M) of 2 numbers each
    left = np.array([1 - row[w].mean() / 2 for row, w in zip(leverages, there, strict=True)])
    left = left.clip(LEAST_LEFT)
    lengths = np.linalg.norm(residuals, axis=1)
    medians = np.array([np.median(row[w]) for row, w in zip(lengths, there, strict=True)])
    noise = (medians / RAYLEIGH / np.sqrt(left)).clip(least)
    common = np.exp(float((left * np.log(noise)).sum() / left.sum()))
    if len(noise) == 2:
        return np.full(2, common)
    return np.asarray(common**POOLED * noise ** (1 - POOLED))


def rays_of(rig: Rigid, images: Float64) -> Float64:
    """Return unit directions (K, 3, M) in the rig's frame; the lens is undone by iteration."""
    flat = (images - rig.centres[..., None]) / np.exp(rig.log_focals)[:, None, None]
    straight = flat
    for _ in range(4):
        squared = np.square(straight).sum(1, keepdims=True)
        bent = 1 + squared * (rig.radial[:, :1, None] + squared * rig.radial[:, 1:, None])
        straight = flat / bent.clip(0.3, 3)
    rays = np.concatenate((straight, np.ones_like(straight[:, :1])), 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned: Float64 = rig.rotations.mT @ rays
    return turned


def _flat(camera: Float64, seen: Seen) -> tuple[Float64, Bool]:
    """Directions (K, 2, M) at depth one, and whether the points have a usual depth (K, M)."""
    depths = camera[:, 2]
    there = seen.weights > 0
    medians = np.array(
        [np.median(row[w]) if w.any() else 1.0 for row, w in zip(depths, there, strict=True)]
    )[:, None]
    visible: Bool = (depths > NEAR * medians) & (depths < FAR * medians) & (medians > 0)
    safe = np.where(visible, depths, 1.0)
    return camera[:, :2] / safe[:, None], visible


def _images(rig: Rigid, flat: Float64) -> tuple[Float64, Float64, Float64]:
    """Images (K, 2, M) of directions (K, 2, M), the lens's gain and the squared radius (K, M)."""
    squared = np.square(flat).sum(1)
    gain = 1 + squared * (rig.radial[:, :1] + squared * rig.radial[:, 1:])
    images = np.exp(rig.log_focals)[:, None, None] * gain[:, None] * flat
    return images + rig.centres[..., None], gain, squared


class _Prior(NamedTuple):
    cost: float  # minus twice the log density
    gradient: Float64  # (K, 5) half that of the cost
    precision: Float64  # (K, 5, K, 5)


def lens_prior(rig: Rigid, beliefs: Beliefs) -> _Prior:
    """Say what is believed of the lenses, as a quadratic about where they are."""
    views = len(rig.log_focals)
    offsets = np.stack((rig.log_focals - np.log(beliefs.focals), *rig.centres.T, *rig.radial.T))
    blocks = beliefs.precisions.copy()
    gradient = (blocks @ offsets[..., None])[..., 0].T
    cost = float((gradient.T * offsets).sum())
    low, high = LOG_WALLS
    beyond = (offsets[0] - high).clip(0) + (offsets[0] - low).clip(max=0)
    cost += float(np.square(beyond / WALL_SD).sum())
    gradient[:, 0] += beyond / WALL_SD**2
    blocks[0] += np.diag((beyond != 0) / WALL_SD**2)
    precision = np.zeros((views, LENS, views, LENS))
    for number in range(LENS):
        precision[:, number, :, number] = blocks[number]
    if beliefs.alike:
        together = _alike(rig.log_focals)
        precision[:, 0, :, 0] += together.precision[:, 0, :, 0]
        gradient[:, 0] += together.gradient[:, 0]
        cost += together.cost
    return _Prior(cost, gradient, precision)


def _alike(log_focals: Float64) -> _Prior:
    """Say that focal lengths are often alike: Cauchy's distribution about their median."""
    views = len(log_focals)
    offsets = log_focals - np.median(log_focals)
    squared = np.square(offsets / ALIKE)
    weights = 2 / (1 + squared) / ALIKE**2
    centring = np.eye(views) - weights / weights.sum()
    precision = np.zeros((views, LENS, views, LENS))
    precision[:, 0, :, 0] = centring.T @ np.diag(weights) @ centring
    gradient = np.zeros((views, LENS))
    gradient[:, 0] = precision[:, 0, :, 0] @ log_focals
    return _Prior(float(2 * np.log1p(squared).sum()), gradient, precision)


def _cost(rig: Rigid, points: Float64, seen: Seen, noise: Float64, beliefs: Beliefs) -> float:
    costs = robust_costs(distances_of(rig, points, seen), seen.weights, noise)
    return float(costs.sum()) + prior_cost(rig, beliefs)


def free_numbers(rig: Rigid, beliefs: Beliefs, *, lenses: bool) -> Bool:
    """Which of the cameras' numbers (K, 11) may change; the first camera's pose is the frame."""
    free = np.ones((len(rig.log_focals), CAMERA), bool)
    free[:, 0] = beliefs.focal_sds > 0
    free[:, 1:3] = (beliefs.centre_covariance.diagonal()[:, None] > 0) & lenses
    bends = beliefs.radial_covariance.diagonal(axis1=1, axis2=2).T > 0  # (K, 2)
    free[:, 3:LENS] = bends & lenses
    free[0, LENS:] = False
    return free


class Reduced(NamedTuple):
    """The normal equations of the cameras, the points eliminated."""

    scores: Float64  # (11 K, M) what each point adds to the vector, besides the prior
    information: Float64  # (11 K, 11 K) of cameras and points
    matrix: Float64  # (11 K, 11 K) of the cameras alone
    vector: Float64  # (11 K,)
    spread: Float64  # (11 K, 3 M) by how much a camera's number moves the points
    solved: Float64  # (3, M) the points' own step


def reduced_equations(
    rig: Rigid, points: Float64, seen: Seen, noise: Float64, beliefs: Beliefs, damping: float
) -> Reduced:
    """Return the normal equations of the cameras about a rig and its points (3, M)."""
    views, count = seen.weights.shape
    residuals, by_camera, by_point = linearised(rig, points, seen, noise)
    # Sums over what a view sees of products of its two rows.
    cross = np.einsum("kiam,kibm->kabm", by_camera, by_point, optimize=True)  # (K, 11, 3, M)
    rows = by_camera.transpose(0, 2, 1, 3).reshape(views, CAMERA, -1)
    information = np.zeros((views, CAMERA, views, CAMERA))
    information[range(views), :, range(views), :] = rows @ rows.mT
    pulls = -np.einsum("kiam,kim->kam", by_camera, residuals)
    right = pulls.sum(-1)
    prior = lens_prior(rig, beliefs)
    information[:, :LENS, :, :LENS] += prior.precision
    right[:, :LENS] -= prior.gradient
    normal = np.einsum("kiam,kibm->abm", by_point, by_point, optimize=True)
    diagonal = normal[range(3), range(3)]
    normal[range(3), range(3)] += damping * diagonal + 1e-9 * diagonal.mean(0) + 1e-12
    inverse = np.linalg.inv(normal.transpose(2, 0, 1)).transpose(1, 2, 0)  # (3, 3, M)
    toward = -np.einsum("kiam,kim->am", by_point, residuals)  # (3, M)
    solved = np.einsum("abm,bm->am", inverse, toward)
    flat = cross.reshape(views * CAMERA, 3, count)
    spread = np.einsum("cam,abm->cbm", flat, inverse, optimize=True)
    flat, spread = flat.reshape(len(flat), -1), spread.reshape(len(flat), -1)
    whole = information.reshape(len(flat), len(flat))
    vector = right.ravel() - flat @ solved.ravel()
    through = np.einsum("cam,am->cm", cross.reshape(-1, 3, count), solved)
    scores = pulls.reshape(-1, count) - through
    return Reduced(scores, whole, whole - spread @ flat.T, vector, spread, solved)


def _step(
    rig: Rigid,
    points: Float64,
    seen: Seen,
    noise: Float64,
    beliefs: Beliefs,
    free: Bool,
    damping: float,
) -> tuple[Rigid, Float64]:
    """Take one damped step of Gauss and Newton, the points eliminated."""
    equations = reduced_equations(rig, points, seen, noise, beliefs, damping)
    places = np.flatnonzero(free)
    matrix = equations.matrix[np.ix_(places, places)]
    root = np.sqrt(equations.information.diagonal()[places])
    root = np.where(root > 0, root, 1.0)
    held = matrix / root / root[:, None] + (damping + LEAST_HELD) * np.eye(len(places))
    step = np.zeros(free.size)
    step[places] = np.linalg.solve(held, equations.vector[places] / root) / root
    moved = equations.solved - (step @ equations.spread).reshape(equations.solved.shape)
    return _moved(rig, step.reshape(free.shape)), points + moved


def settle_points(
    rig: Rigid, points: Float64, seen: Seen, noise: Float64, *, steps: int = POINT_STEPS
) -> Float64:
    """Improve points (3, M) while cameras stay, by steps of Gauss and Newton that gain."""

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


def _moved(rig: Rigid, step: Float64) -> Rigid:
    return Rigid(
        rig.log_focals + step[:, 0].clip(-0.3, 0.3),
        rig.centres + step[:, 1:3],
        (rig.radial + step[:, 3:LENS]).clip(-2, 2),
        rotations_from_vectors(step[:, LENS : LENS + 3]) @ rig.rotations,
        rig.translations + step[:, LENS + 3 :],
    )


def linearised(
    rig: Rigid, points: Float64, seen: Seen, noise: Float64
) -> tuple[Float64, Float64, Float64]:
    """Return weighted residuals (K, 2, M), and derivatives by cameras and points.

    These are (K, 2, 11, M) and (K, 2, 3, M).
    """
    turned = rig.rotations @ points
    camera = turned + rig.translations[..., None]
    flat, visible = _flat(camera, seen)
    images, gain, squared = _images(rig, flat)
    residuals = images - seen.images
    lengths = np.square(residuals).sum(1) / np.square(noise)[:, None]
    weights = seen.weights * visible * (FREEDOM + 2) / (FREEDOM + lengths)
    root = np.sqrt(weights) / noise[:, None]  # (K, M)
    focals = np.exp(rig.log_focals)[:, None]
    views, count = root.shape
    depths = np.where(visible, camera[:, 2], 1.0)
    by_camera = np.zeros((views, 2, CAMERA, count))
    by_camera[:, :, 0] = focals[..., None] * gain[:, None] * flat
    by_camera[:, 0, 1] = by_camera[:, 1, 2] = 1
    by_camera[:, :, 3] = focals[..., None] * squared[:, None] * flat
    by_camera[:, :, 4] = squared[:, None] * by_camera[:, :, 3]
    by_held = _by_held(rig, flat, depths)
    by_camera[:, :, LENS + 3 :] = by_held
    by_camera[:, :, LENS : LENS + 3] = np.cross(turned[:, None], by_held, axis=2)
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations, optimize=True)
    return (
        residuals * root[:, None],
        by_camera * root[:, None, None],
        by_point * root[:, None, None],
    )


def residuals_by_points(rig: Rigid, points: Float64, seen: Seen) -> tuple[Float64, Float64]:
    """Residuals (K, 2, M) of points (3, M) in sides, and their derivatives (K, 2, 3, M) by these.

    Both are 0 where a camera cannot see the point.
    """
    camera = rig.rotations @ points + rig.translations[..., None]
    flat, visible = _flat(camera, seen)
    images, _, _ = _images(rig, flat)
    by_held = _by_held(rig, flat, np.where(visible, camera[:, 2], 1.0))
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations, optimize=True)
    there = (visible & (seen.weights > 0))[:, None]
    return np.where(there, images - seen.images, 0.0), by_point * there[:, None]


def _by_held(rig: Rigid, flat: Float64, depths: Float64) -> Float64:
    """Return derivatives (K, 2, 3, M) of images by points in their camera's frame."""
    views, _, count = flat.shape
    focals = np.exp(rig.log_focals)[:, None]
    squared = np.square(flat).sum(1)
    gain = 1 + squared * (rig.radial[:, :1] + squared * rig.radial[:, 1:])
    slope = 2 * rig.radial[:, :1] + 4 * rig.radial[:, 1:] * squared
    by_flat = np.empty((views, 2, 2, count))
    a, b = flat[:, 0], flat[:, 1]
    by_flat[:, 0, 0] = focals * (gain + slope * a * a)
    by_flat[:, 0, 1] = by_flat[:, 1, 0] = focals * slope * a * b
    by_flat[:, 1, 1] = focals * (gain + slope * b * b)
    by_flat /= depths[:, None, None]
    return np.concatenate((by_flat, -(by_flat * flat[:, None]).sum(2, keepdims=True)), 2)
