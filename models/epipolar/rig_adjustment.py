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

CAMERA = 10  # numbers: log focal, principal point, radial coefficient, rotation vector, translation
LENS = 4
FREEDOM = 3.0  # of Student's t
RAYLEIGH = 1.1774  # median length of a pair of unit normal numbers
LEAST_NOISE = 1e-3  # sides: what lens models leave, and a start need not tell
POOLED = 2 / 3  # share of the common noise in the log of each view's
NEAR, FAR = 0.2, 5.0  # median depths between which a point has a say
BLIND = 30.0  # standard deviations that stand for a point that a camera cannot see there
ALIKE = 0.02  # scale of Cauchy's distribution of the log ratio of focal lengths
LOG_WALLS = np.log((0.3, 4.5))  # factors of the expected focal length that no lens goes beyond
WALL_SD = 0.05
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e8
CONVERGED = 1e-5


class Rigid(NamedTuple):
    """K cameras at rest, x = R X + t, and their lenses in sides of the image."""

    log_focals: Float64  # (K,)
    centres: Float64  # (K, 2) from the expected principal points
    radial: Float64  # (K,) first radial coefficients
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
        scale = max(float(np.median(angles[there & several])), LEAST_NOISE)
        weights = seen.weights / (1 + np.square(angles / scale) / FREEDOM)
    return points


def images_of(rig: Rigid, points: Float64, seen: Seen) -> tuple[Float64, Bool]:
    """Return images (K, 2, M) of points (3, M), and whether (K, M) a camera can see them there."""
    flat, visible = _flat(rig.rotations @ points + rig.translations[..., None], seen)
    return _images(rig, flat)[0], visible


def distances_of(rig: Rigid, points: Float64, seen: Seen, noise: Float64) -> Float64:
    """Sides (K, M) from what is seen to the points' images; `BLIND` noises where none can be."""
    images, visible = images_of(rig, points, seen)
    lengths = np.linalg.norm(images - seen.images, axis=1)
    most = BLIND * noise[:, None]
    # What is far off is an outlier anyway; so a start that cannot see it does not gain by that.
    distances: Float64 = np.where(visible, np.minimum(lengths, most), most)
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
) -> Adjusted:
    """Adjust cameras and points (3, M); without `lenses`, only focal lengths are free of these.

    The noise of each view is learnt from its median distance on the way.
    """
    free = free_numbers(rig, beliefs, lenses=lenses)
    noise = noise_of(rig, points, seen)
    damping, learn_noise = FIRST_DAMPING, 3
    cost = _cost(rig, points, seen, noise, beliefs)
    for iteration in range(iterations):
        if iteration % learn_noise == 0:
            noise = noise_of(rig, points, seen)
            cost = _cost(rig, points, seen, noise, beliefs)
        tried_rig, tried = _step(rig, points, seen, noise, beliefs, free, damping)
        tried_cost = _cost(tried_rig, tried, seen, noise, beliefs)
        if tried_cost <= cost:
            gained = cost - tried_cost
            rig, points, cost = tried_rig, tried, tried_cost
            damping = max(damping / 5, 1e-9)
            if gained < CONVERGED * seen.weights.sum() and iteration % learn_noise:
                break
        else:
            damping *= 8
            if damping > MOST_DAMPING:
                break
    return Adjusted(rig, points, noise_of(rig, points, seen))


def noise_of(rig: Rigid, points: Float64, seen: Seen) -> Float64:
    """Noise (K,) of a coordinate in each view, by medians, for the most part what views share."""
    count = (seen.weights > 0).sum()
    points_seen = (seen.weights > 0).any(0).sum()
    # Points take three of the two numbers of each observation.
    freedom = np.sqrt(max(1 - 1.5 * points_seen / max(count, 1), 0.15))
    distances = distances_of(rig, points, seen, np.ones(len(seen.images)))
    medians = np.array(
        [
            np.median(row[w > 0]) if (w > 0).any() else np.nan
            for row, w in zip(distances, seen.weights, strict=True)
        ]
    )
    noise = (medians / RAYLEIGH / freedom).clip(LEAST_NOISE)
    common = float(np.nanmedian(noise))
    noise = np.where(np.isfinite(noise), noise, common)
    if len(noise) == 2:
        return np.full(2, common)
    return np.asarray(common**POOLED * noise ** (1 - POOLED))


def rays_of(rig: Rigid, images: Float64) -> Float64:
    """Return unit directions (K, 3, M) in the rig's frame; the lens is undone by iteration."""
    flat = (images - rig.centres[..., None]) / np.exp(rig.log_focals)[:, None, None]
    straight = flat
    for _ in range(4):
        squared = np.square(straight).sum(1, keepdims=True)
        straight = flat / (1 + rig.radial[:, None, None] * squared).clip(0.3, 3)
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
    gain = 1 + rig.radial[:, None] * squared
    images = np.exp(rig.log_focals)[:, None, None] * gain[:, None] * flat
    return images + rig.centres[..., None], gain, squared


class _Prior(NamedTuple):
    cost: float  # minus twice the log density
    gradient: Float64  # (K, 4) half that of the cost
    precision: Float64  # (K, 4, K, 4)


def lens_prior(rig: Rigid, beliefs: Beliefs) -> _Prior:
    """Say what is believed of the lenses, as a quadratic about where they are."""
    views = len(rig.log_focals)
    offsets = np.stack((rig.log_focals - np.log(beliefs.focals), *rig.centres.T, rig.radial))
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
    together = _alike(rig.log_focals)
    precision[:, 0, :, 0] += together.precision[:, 0, :, 0]
    gradient[:, 0] += together.gradient[:, 0]
    return _Prior(cost + together.cost, gradient, precision)


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
    costs = robust_costs(distances_of(rig, points, seen, noise), seen.weights, noise)
    return float(costs.sum()) + prior_cost(rig, beliefs)


def free_numbers(rig: Rigid, beliefs: Beliefs, *, lenses: bool) -> Bool:
    """Which of the cameras' numbers (K, 10) may change; the first camera's pose is the frame."""
    free = np.ones((len(rig.log_focals), CAMERA), bool)
    free[:, 0] = beliefs.focal_sds > 0
    free[:, 1:3] = (beliefs.centre_covariance.diagonal()[:, None] > 0) & lenses
    free[:, 3] = (beliefs.radial_covariance.diagonal() > 0) & lenses
    free[0, LENS:] = False
    return free


class Reduced(NamedTuple):
    """The normal equations of the cameras, the points eliminated."""

    information: Float64  # (10 K, 10 K) of cameras and points
    matrix: Float64  # (10 K, 10 K) of the cameras alone
    vector: Float64  # (10 K,)
    spread: Float64  # (10 K, 3 M) by how much a camera's number moves the points
    solved: Float64  # (3, M) the points' own step


def reduced_equations(
    rig: Rigid, points: Float64, seen: Seen, noise: Float64, beliefs: Beliefs, damping: float
) -> Reduced:
    """Return the normal equations of the cameras about a rig and its points (3, M)."""
    views, count = seen.weights.shape
    residuals, by_camera, by_point = _linearised(rig, points, seen, noise)
    # Sums over what a view sees of products of its two rows.
    cross = np.einsum("kiam,kibm->kabm", by_camera, by_point, optimize=True)  # (K, 10, 3, M)
    rows = by_camera.transpose(0, 2, 1, 3).reshape(views, CAMERA, -1)
    information = np.zeros((views, CAMERA, views, CAMERA))
    information[range(views), :, range(views), :] = rows @ rows.mT
    right = -np.einsum("kan,kn->ka", rows, residuals.reshape(views, -1))
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
    return Reduced(whole, whole - spread @ flat.T, vector, spread, solved)


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
    scale = equations.information.diagonal()[places]
    step = np.zeros(free.size)
    step[places] = np.linalg.solve(
        matrix + np.diag(damping * scale + 1e-9), equations.vector[places]
    )
    moved = equations.solved - (step @ equations.spread).reshape(equations.solved.shape)
    return _moved(rig, step.reshape(free.shape)), points + moved


def _moved(rig: Rigid, step: Float64) -> Rigid:
    return Rigid(
        rig.log_focals + step[:, 0].clip(-0.3, 0.3),
        rig.centres + step[:, 1:3],
        (rig.radial + step[:, 3]).clip(-2, 2),
        rotations_from_vectors(step[:, 4:7]) @ rig.rotations,
        rig.translations + step[:, 7:],
    )


def _linearised(
    rig: Rigid, points: Float64, seen: Seen, noise: Float64
) -> tuple[Float64, Float64, Float64]:
    """Weighted residuals (K, 2, M), by the cameras (K, 2, 10, M), by the points (K, 2, 3, M)."""
    turned = rig.rotations @ points
    camera = turned + rig.translations[..., None]
    flat, visible = _flat(camera, seen)
    images, gain, squared = _images(rig, flat)
    residuals = images - seen.images
    lengths = np.square(residuals).sum(1) / np.square(noise)[:, None]
    weights = seen.weights * visible * (lengths < BLIND**2) * (FREEDOM + 2) / (FREEDOM + lengths)
    root = np.sqrt(weights) / noise[:, None]  # (K, M)
    focals = np.exp(rig.log_focals)[:, None]
    views, count = root.shape
    depths = np.where(visible, camera[:, 2], 1.0)
    by_camera = np.zeros((views, 2, CAMERA, count))
    by_camera[:, :, 0] = focals[..., None] * gain[:, None] * flat
    by_camera[:, 0, 1] = by_camera[:, 1, 2] = 1
    by_camera[:, :, 3] = focals[..., None] * squared[:, None] * flat
    by_held = _by_held(rig, flat, gain, depths)
    by_camera[:, :, 7:] = by_held
    by_camera[:, :, 4:7] = np.cross(turned[:, None], by_held, axis=2)
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
    images, gain, _ = _images(rig, flat)
    by_held = _by_held(rig, flat, gain, np.where(visible, camera[:, 2], 1.0))
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations, optimize=True)
    there = (visible & (seen.weights > 0))[:, None]
    return np.where(there, images - seen.images, 0.0), by_point * there[:, None]


def _by_held(rig: Rigid, flat: Float64, gain: Float64, depths: Float64) -> Float64:
    """Return derivatives (K, 2, 3, M) of images by points in their camera's frame."""
    views, _, count = flat.shape
    focals = np.exp(rig.log_focals)[:, None]
    slope = 2 * rig.radial[:, None]
    by_flat = np.empty((views, 2, 2, count))
    a, b = flat[:, 0], flat[:, 1]
    by_flat[:, 0, 0] = focals * (gain + slope * a * a)
    by_flat[:, 0, 1] = by_flat[:, 1, 0] = focals * slope * a * b
    by_flat[:, 1, 1] = focals * (gain + slope * b * b)
    by_flat /= depths[:, None, None]
    return np.concatenate((by_flat, -(by_flat * flat[:, None]).sum(2, keepdims=True)), 2)
