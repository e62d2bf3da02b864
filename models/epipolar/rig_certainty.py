"""Covariances of static cameras that hold although errors repeat.

Errors of detectors and of lens models repeat from frame to frame and from keypoint to keypoint, so
the inverse of the information is too small. The sandwich estimator uses the scatter of the
gradients of whole frames, and of whole keypoints, instead (Huber, 1967; clusters in two ways:
Cameron, Gelbach and Miller, *Robust inference with multiway clustering*, 2011).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, free_numbers, lens_prior, reduced_equations
from models.epipolar.static_cameras import (
    CAMERA,
    FREEDOM,
    LENS,
    SeenPoints,
    StaticCameras,
    distances_of,
)

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

TINY = 1e-9  # of the largest eigenvalue of the scaled information: below, nothing is known


class FocalLikelihood(NamedTuple):
    """The likelihood of the logs x (K,) of focal lengths: -x' A x / 2 + b' x, a log density."""

    information: Float64  # A (K, K)
    vector: Float64  # b (K,)


class Certainty(NamedTuple):
    """Standard deviations of K cameras, and the likelihood of their focal lengths."""

    # (K, 11) standard deviations of the numbers of `StaticCameras`, 0 of those that are held.
    deviations: Float64
    focals: FocalLikelihood


def certainty_of(
    adjusted: AdjustedRig, seen: SeenPoints, beliefs: Beliefs, clusters: tuple[Int64, Int64]
) -> Certainty:
    """Compute standard deviations of cameras estimated from points; errors repeat in clusters (M,).

    There are two ways of clustering: frames and keypoints. Rotations and translations are relative
    to the first camera. Translations are in the unit of the points, which the lengths of the
    translations fix. No deviation is smaller than that of independent errors.
    """
    rig = adjusted.rig
    equations = reduced_equations(rig, adjusted.points, seen, adjusted.noise, beliefs, 0.0)
    free = free_numbers(rig, beliefs, lenses=True)
    places = np.flatnonzero(free)
    prior = lens_prior(rig, beliefs)
    numbers = CAMERA * np.arange(len(free))[:, None] + np.arange(LENS)
    believed = np.zeros(equations.information.shape)
    of_lenses = np.ix_(numbers.ravel(), numbers.ravel())
    believed[of_lenses] = prior.precision.reshape(numbers.size, -1)
    data = _curvature(adjusted, seen) * (equations.matrix(np.arange(free.size)) - believed)
    some = np.ix_(places, places)
    scatter = np.zeros(data.shape)
    scatter[some] = _scatter(equations.scores[places], clusters)
    covariance = _inverse((data + believed)[some], rig.translations, free)
    robust = covariance @ (scatter + believed)[some] @ covariance
    sds = np.zeros(free.size)
    sds[places] = np.sqrt(np.maximum(covariance.diagonal(), robust.diagonal()).clip(0))
    focals = numbers[:, 0]
    believed[np.ix_(focals, focals)] = 0.0
    vector = equations.vector.copy()
    vector[focals] += prior.gradient[:, 0]
    others = np.setdiff1d(places, focals)
    return Certainty(
        sds.reshape(free.shape),
        _focal_likelihood(data + believed, scatter, vector, focals, others, rig),
    )


def _focal_likelihood(
    matrix: Float64,
    scatter: Float64,
    vector: Float64,
    focals: Int64,
    others: Int64,
    rig: StaticCameras,
) -> FocalLikelihood:
    """Return the likelihood of the focal lengths from keypoints alone, with all else optimised.

    The information of repeated errors is divided by the factor by which their sums scatter more
    (the design effect: Kish, *Survey Sampling*, 1965).
    """
    among = matrix[np.ix_(others, others)]
    small = np.diag(TINY * among.diagonal() + TINY)
    carried = np.linalg.solve(among + small, matrix[np.ix_(others, focals)]).T
    information = matrix[np.ix_(focals, focals)] - carried @ matrix[np.ix_(others, focals)]
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    values = values.clip(TINY * max(values[-1], TINY))
    turn = np.zeros((len(focals), len(matrix)))
    turn[:, focals] = np.eye(len(focals))
    turn[:, others] = -carried
    scattered = vectors.T @ turn @ scatter @ turn.T @ vectors
    effect = np.maximum(1.0, scattered.diagonal() / values)
    step = (vectors / values) @ vectors.T @ (vector[focals] - carried @ vector[others])
    information = (vectors * (values / effect)) @ vectors.T
    return FocalLikelihood(information, information @ (rig.log_focals + step))


def _curvature(adjusted: AdjustedRig, seen: SeenPoints) -> float:
    """Curvature of Student's t where residuals lie, as a share of that of its quadratic bound."""
    distances = distances_of(adjusted.rig, adjusted.points, seen)
    squared = np.square(distances / adjusted.noise[:, None])
    weights = seen.weights / (FREEDOM + squared)
    return float((weights * FREEDOM / (FREEDOM + squared)).sum() / weights.sum())


def _scatter(scores: Float64, clusters: tuple[Int64, Int64]) -> Float64:
    """Covariance (n, n) of sums of scores (n, M) whose points err together in two ways."""
    total = -scores @ scores.T
    for labels in clusters:
        sums = np.array([np.bincount(labels, row) for row in scores])
        total = total + sums @ sums.T
    values, vectors = np.linalg.eigh(total)
    return np.asarray((vectors * values.clip(0)) @ vectors.T)


def _inverse(matrix: Float64, translations: Float64, free: NDArray[np.bool_]) -> Float64:
    """Invert the information (n, n) of the free numbers, with the overall size held."""
    growth = np.zeros(free.shape)  # the direction in which the whole rig grows
    growth[:, LENS + 3 :] = translations
    along = growth.ravel()[np.flatnonzero(free)]
    along /= np.linalg.norm(along)
    root = np.sqrt(matrix.diagonal().clip(1e-12))
    scaled = matrix / root / root[:, None]
    held = along * root
    held /= np.linalg.norm(held)
    scaled = scaled + len(root) * np.outer(held, held)
    values, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    inverse = (vectors / values.clip(TINY * values[-1])) @ vectors.T
    return np.asarray(inverse / root / root[:, None])
