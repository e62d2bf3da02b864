"""Sharpening frames from which noise was removed, with the structures that a fit knows.

Noise removal compares frames by their keypoints in the images. Structures can be compared wherever
the subject is and whichever way it faces, so more frames are alike.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.known_structures import NOISY_NEIGHBOURS, NOISY_SPREAD, prior_of_neighbours
from models.bundle.problem import ShapePrior, Views
from models.lifting.explanations import (
    Explanation,
    Refiner,
    align_explanation_into,
    copy_explanation,
)
from models.lifting.neighbours import coverage_into
from models.lifting.point_information import inform_points
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, inverse_symmetric, product
from models.optics.lenses.projection import Lenses, project_into

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Figures: evidence/lifts.md.
UNLIKE = 2.0  # standard errors by which a frame must lie further off than is explained
NEAR, FAR = 4.0, 18.0  # variances of noise: where heavier tails begin, and where all is tail


@inner
def sharpen(
    refiner: Refiner, detected: Views, usable: Bool, explanation: Explanation, buffer: Explanation
) -> None:
    """Find the most likely points given the keypoints as `detected` and the known structures.

    Cameras stay as they are. The twenty known structures nearest to the explanation make a Gaussian
    prior of the frame (`prior_of_neighbours`). The squared distance of the result from prior and
    keypoints is divided by its expectation. If this ratio is above 1 by more than chance, the frame
    is unlike all known ones, and the offset of the prior's mean from the explanation is divided by
    the square of the ratio. Weights of `detected` are inverse variances; keypoints far off get
    less. `buffer` is overwritten.
    """
    count = len(explanation.points)
    shown, rays = np.zeros(count, np.int64), np.empty((count, 3))
    scale = align_explanation_into(explanation, refiner.prior.means, buffer)
    coverage_into(detected, usable, buffer, shown, rays)
    prior = prior_of_neighbours(
        refiner.known, buffer.points, shown, rays, NOISY_NEIGHBOURS, NOISY_SPREAD
    )
    lenses = refiner.rig.lenses
    _reduce_weights_of_far(lenses, detected, buffer)
    information, pull = np.empty((count, 3, 3)), np.empty((count, 3))
    inform_points(
        buffer.points, buffer.rotations, buffer.translations, lenses, detected, information, pull
    )
    before, numbers = buffer.points.copy(), 2 * shown.sum()
    squared = most_likely(prior, before, information, pull, buffer.points)
    squared += _squared_errors(lenses, detected, buffer)
    times = squared / max(numbers, 1)
    if times > 1.0 + UNLIKE * math.sqrt(2.0 / max(numbers, 1)):
        for p in range(count):
            for i in range(3):
                off = prior.means[p, i] - before[p, i]
                prior.means[p, i] = before[p, i] + off / times**2
        most_likely(prior, before, information, pull, buffer.points)
    for p in range(count):
        for i in range(3):
            buffer.points[p, i] /= scale
    for k in range(len(usable)):
        for i in range(3):
            buffer.translations[k, i] /= scale
    copy_explanation(buffer, explanation)


@inner
def _reduce_weights_of_far(lenses: Lenses, views: Views, explanation: Explanation) -> None:
    """Weight keypoints that are more than `NEAR` variances off as Huber's loss does."""
    for k in range(len(views.weights)):
        for p in range(len(explanation.points)):
            squared = _squared_error(lenses, views, explanation, k, p)
            if squared > NEAR:
                views.weights[k, p] *= math.sqrt(NEAR / squared)


@inner
def _squared_errors(lenses: Lenses, views: Views, explanation: Explanation) -> float:
    """Return the squared errors of keypoints, in variances of their noise; at most `FAR` each."""
    squared = 0.0
    for k in range(len(views.weights)):
        for p in range(len(explanation.points)):
            squared += min(_squared_error(lenses, views, explanation, k, p), FAR)
    return squared


@inner
def _squared_error(lenses: Lenses, views: Views, explanation: Explanation, k: int, p: int) -> float:
    """Return the squared reprojection error of keypoint p in view k, times its weight."""
    if views.weights[k, p] == 0:
        return 0.0
    rotation, translation = explanation.rotations[k], explanation.translations[k]
    camera, pixel = np.empty(3), np.empty(2)
    for i in range(3):
        camera[i] = translation[i]
        for j in range(3):
            camera[i] += rotation[i, j] * explanation.points[p, j]
    project_into(camera, lenses, k, pixel)
    x, y = pixel[0] - views.keypoints[k, p, 0], pixel[1] - views.keypoints[k, p, 1]
    return float(views.weights[k, p] * (x * x + y * y))


@inner
def most_likely(
    prior: ShapePrior, origin: Float64, information: Float64, pull: Float64, points: Float64
) -> float:
    """Compute the most likely points (P, 3); return their squared distance from the prior.

    `information` (P, 3, 3) and `pull` (P, 3) are the normal equations of the keypoints about
    `origin` (P, 3). A point is its mean plus the prior's directions times the scores plus an
    isotropic part of its own. The equations of the scores are those with this part integrated out.
    """
    size = prior.basis.shape[1]
    pull_at_mean, lasting = np.empty(points.shape), np.empty(information.shape)
    system, scores = np.zeros((size, size)), np.zeros(size)
    for p in range(len(points)):
        for i in range(3):
            pull_at_mean[p, i] = pull[p, i]
            for j in range(3):
                pull_at_mean[p, i] += information[p, i, j] * (origin[p, j] - prior.means[p, j])
        _add_equations(
            prior.basis[3 * p : 3 * p + 3],
            prior.spread,
            information[p],
            pull_at_mean[p],
            lasting[p],
            system,
            scores,
        )
    for q in range(size):
        system[q, q] += 1.0
    cholesky(system)
    cholesky_solve(system, scores)
    misfit = 0.0
    for q in range(size):
        misfit += scores[q] ** 2
    for p in range(len(points)):
        misfit += _place(
            prior.basis[3 * p : 3 * p + 3],
            prior.spread,
            information[p],
            pull_at_mean[p],
            lasting[p],
            scores,
            points[p],
        )
        for i in range(3):
            points[p, i] += prior.means[p, i]
    return misfit


@inner
def _add_equations(
    basis: Float64,
    spread: float,
    information: Float64,
    pull_at_mean: Float64,
    lasting: Float64,
    system: Float64,
    right: Float64,
) -> None:
    """Add the equations of the scores from one point with `basis` (3, Q), and write L (3, 3).

    L = (1 + spread^2 information)^-1 is the share of the information that is left once the
    point's own part is integrated out. Only the lower half of the (Q, Q) system is written.
    """
    scaled, reduced = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = spread**2 * information[i, j]
    inverse_symmetric(scaled, 1.0, lasting)
    product(lasting, information, reduced)
    along = np.empty(3)
    for q in range(basis.shape[1]):
        for i in range(3):
            along[i] = 0.0
            for j in range(3):
                along[i] += reduced[i, j] * basis[j, q]
                right[q] += basis[i, q] * lasting[i, j] * pull_at_mean[j]
        for r in range(q + 1):
            for i in range(3):
                system[q, r] += along[i] * basis[i, r]


@inner
def _place(
    basis: Float64,
    spread: float,
    information: Float64,
    pull_at_mean: Float64,
    lasting: Float64,
    scores: Float64,
    offset: Float64,
) -> float:
    """Write the offset (3,) of a point from its mean; return the squared size of its own part."""
    remaining, squared = pull_at_mean.copy(), 0.0
    for i in range(3):
        offset[i] = 0.0
        for q in range(len(scores)):
            offset[i] += basis[i, q] * scores[q]
    for i in range(3):
        for j in range(3):
            remaining[i] -= information[i, j] * offset[j]
    for i in range(3):
        own = 0.0
        for j in range(3):
            own += spread**2 * lasting[i, j] * remaining[j]
        offset[i] += own
        squared += (own / spread) ** 2
    return squared
