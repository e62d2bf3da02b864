"""Frames from which noise was removed, sharpened by the structures that a fit knows.

Removing noise looks for frames whose keypoints lie alike in the images. Structures are alike
wherever in the room the subject is and whichever way it looks, so there are more to learn from.
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
from models.lifting.neighbours import what_is_told
from models.lifting.told_points import inform_points
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, inverse_symmetric, product
from models.optics.lenses.projection import Lenses, project_into

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

UNLIKE = 2.0  # standard errors by which a frame must lie further off than is explained
NEAR, FAR = 4.0, 18.0  # variances of noise: where heavier tails begin, and where all is tail


@inner
def sharpen(
    refiner: Refiner, detected: Views, usable: Bool, explanation: Explanation, room: Explanation
) -> None:
    """Write the most likely points among known structures for keypoints as they were `detected`.

    Its cameras stay. The twenty known structures nearest to the explanation make a Gaussian prior
    of the frame (`prior_of_neighbours`). If the outcome is further from it and from the keypoints
    than both explain, the frame is unlike all that is known: by the square of how many times its
    squared distance is what they expect, the prior's mean goes back towards the explanation.
    Weights of `detected` are inverse variances; what is far off is given less.
    """
    count = len(explanation.points)
    shown, rays = np.zeros(count, np.int64), np.empty((count, 3))
    scale = align_explanation_into(explanation, refiner.prior.means, room)
    what_is_told(detected, usable, room, shown, rays)
    prior = prior_of_neighbours(
        refiner.known, room.points, shown, rays, NOISY_NEIGHBOURS, NOISY_SPREAD
    )
    lenses = refiner.rig.lenses
    _trust_less_what_is_far(lenses, detected, room)
    information, pull = np.empty((count, 3, 3)), np.empty((count, 3))
    inform_points(
        room.points, room.rotations, room.translations, lenses, detected, information, pull
    )
    before, numbers = room.points.copy(), 2 * shown.sum()
    squared = most_likely(prior, before, information, pull, room.points)
    squared += _squared_errors(lenses, detected, room)
    times = squared / max(numbers, 1)
    if times > 1.0 + UNLIKE * math.sqrt(2.0 / max(numbers, 1)):
        for p in range(count):
            for i in range(3):
                off = prior.means[p, i] - before[p, i]
                prior.means[p, i] = before[p, i] + off / times**2
        most_likely(prior, before, information, pull, room.points)
    for p in range(count):
        for i in range(3):
            room.points[p, i] /= scale
    for k in range(len(usable)):
        for i in range(3):
            room.translations[k, i] /= scale
    copy_explanation(room, explanation)


@inner
def _trust_less_what_is_far(lenses: Lenses, views: Views, explanation: Explanation) -> None:
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
    """Write the most likely points (P, 3), and return how far from the prior they are, squared.

    Keypoints tell inverse covariances (P, 3, 3) and, times these, where points are from `origin`.
    A point is its mean, what the prior's directions make of it, and something of its own. What
    keypoints tell in spite of the latter makes the equations of the former.
    """
    size = prior.basis.shape[1]
    said, lasting = np.empty(points.shape), np.empty(information.shape)
    system, scores = np.zeros((size, size)), np.zeros(size)
    for p in range(len(points)):
        for i in range(3):
            said[p, i] = pull[p, i]
            for j in range(3):
                said[p, i] += information[p, i, j] * (origin[p, j] - prior.means[p, j])
        _add_equations(
            prior.basis[3 * p : 3 * p + 3],
            prior.spread,
            information[p],
            said[p],
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
            said[p],
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
    said: Float64,
    lasting: Float64,
    system: Float64,
    right: Float64,
) -> None:
    """Add what keypoints tell of the scores by a point, whose `basis` is (3, Q), and write L.

    L = (1 + spread^2 information)^-1 is how much of it lasts, as the point has something of its
    own. Of the (Q, Q) system the lower half is written.
    """
    scaled, told = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = spread**2 * information[i, j]
    inverse_symmetric(scaled, 1.0, lasting)
    product(lasting, information, told)
    along = np.empty(3)
    for q in range(basis.shape[1]):
        for i in range(3):
            along[i] = 0.0
            for j in range(3):
                along[i] += told[i, j] * basis[j, q]
                right[q] += basis[i, q] * lasting[i, j] * said[j]
        for r in range(q + 1):
            for i in range(3):
                system[q, r] += along[i] * basis[i, r]


@inner
def _place(
    basis: Float64,
    spread: float,
    information: Float64,
    said: Float64,
    lasting: Float64,
    scores: Float64,
    offset: Float64,
) -> float:
    """Write where a point is from its mean (3,); returns how far its own part is, squared."""
    rest, squared = said.copy(), 0.0
    for i in range(3):
        offset[i] = 0.0
        for q in range(len(scores)):
            offset[i] += basis[i, q] * scores[q]
    for i in range(3):
        for j in range(3):
            rest[i] -= information[i, j] * offset[j]
    for i in range(3):
        own = 0.0
        for j in range(3):
            own += spread**2 * lasting[i, j] * rest[j]
        offset[i] += own
        squared += (own / spread) ** 2
    return squared
