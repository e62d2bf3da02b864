"""What keypoints say of cameras at rest, and how surely: information, deviations, repetition."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import (
    BLIND,
    CAMERA,
    FREEDOM,
    LENS,
    Adjusted,
    Seen,
    free_numbers,
    images_of,
    lens_prior,
    reduced_equations,
)

Float64 = NDArray[np.float64]


class FocalLikelihood(NamedTuple):
    """What keypoints say of the logs x (K,) of focal lengths: -x' A x / 2 + b' x, a log density."""

    information: Float64  # A (K, K)
    vector: Float64  # b (K,)


def focal_likelihood(adjusted: Adjusted, seen: Seen, beliefs: Beliefs) -> FocalLikelihood:
    """Say what keypoints alone tell of the focal lengths; poses and points follow them."""
    rig = adjusted.rig
    equations = reduced_equations(rig, adjusted.points, seen, adjusted.noise, beliefs, 0.0)
    prior = lens_prior(rig, beliefs)
    views = len(rig.log_focals)
    focals = np.arange(views) * CAMERA
    others = np.setdiff1d(np.flatnonzero(free_numbers(rig, beliefs, lenses=True)), focals)
    matrix, vector = equations.matrix.copy(), equations.vector.copy()
    matrix[np.ix_(focals, focals)] -= prior.precision[:, 0, :, 0]
    vector[focals] += prior.gradient[:, 0]
    among = matrix[np.ix_(others, others)]
    carried = np.linalg.solve(among + 1e-9 * np.eye(len(others)), matrix[np.ix_(others, focals)]).T
    information = matrix[np.ix_(focals, focals)] - carried @ matrix[np.ix_(others, focals)]
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    information = (vectors * values.clip(0)) @ vectors.T
    pull = vector[focals] - carried @ vector[others]
    return FocalLikelihood(information, information @ rig.log_focals + pull)


def camera_deviations(adjusted: Adjusted, seen: Seen, beliefs: Beliefs) -> Float64:
    """Say how surely (K, 10) the cameras' numbers are known: standard deviations, 0 where told.

    Rotations and translations are relative to the first camera, translations in the unit of the
    points, which is kept by the lengths of the translations.
    """
    rig = adjusted.rig
    equations = reduced_equations(rig, adjusted.points, seen, adjusted.noise, beliefs, 0.0)
    free = free_numbers(rig, beliefs, lenses=True)
    places = np.flatnonzero(free)
    growth = np.zeros(free.shape)  # of a rig that is taken for larger
    growth[:, LENS + 3 :] = rig.translations
    along = growth.ravel()[places]
    along /= np.linalg.norm(along)
    matrix = equations.matrix[np.ix_(places, places)]
    scale = matrix.diagonal()
    held = matrix + np.diag(1e-9 * scale + 1e-12) + scale.max() * np.outer(along, along)
    sds = np.zeros(free.size)
    sds[places] = np.sqrt(np.linalg.inv(held).diagonal().clip(0))
    return sds.reshape(free.shape)


def repetition(adjusted: Adjusted, seen: Seen, clusters: NDArray[np.int64]) -> float:
    """By how much errors repeat in `clusters` (M,) of points: 1 where all are independent.

    The variance of sums over a cluster in a view, over what it would be (the design effect; Kish,
    *Survey Sampling*, 1965): so many observations say no more than one. What they say of the
    cameras would not tell, for cameras have taken up what errors say of them.
    """
    images, visible = images_of(adjusted.rig, adjusted.points, seen)
    residuals = images - seen.images  # (K, 2, M)
    squared = np.square(residuals).sum(1) / np.square(adjusted.noise)[:, None]
    weights = seen.weights * visible * (squared < BLIND**2) / (FREEDOM + squared)
    pulls = residuals * weights[:, None]
    sums = np.array([[np.bincount(clusters, row) for row in of_view] for of_view in pulls])
    # What is far below the noise that lens models are granted repeats, but does no harm.
    granted = 2 * np.square(adjusted.noise[:, None] * seen.weights / (FREEDOM + 2)).sum()
    alone = max(float(np.square(pulls).sum()), float(granted))
    return max(1.0, float(np.square(sums).sum()) / alone)
