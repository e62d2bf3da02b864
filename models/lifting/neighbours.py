"""Estimating keypoints seen by fewer than two views from the most similar known structures."""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.known_structures import prior_of_neighbours
from models.bundle.problem import SIMILARITY, Rig, Views
from models.lifting.explanations import (
    Explanation,
    Refiner,
    align_explanation_into,
    copy_explanation,
    explain_with,
)
from models.numerics.compiled import inner
from models.numerics.matrices import total

Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]
Float64 = NDArray[np.float64]


@inner
def complete_from_neighbours(
    refiner: Refiner,
    rig: Rig,
    views: Views,
    usable: Bool,
    explanation: Explanation,
    start: Explanation,
    other: Explanation,
) -> None:
    """Explain a frame again with a prior of its neighbours, if fewer than two views see a keypoint.

    `misfit` is the squared Mahalanobis distance of the explanation from the neighbours' prior.
    Divided by its expectation, it is the prior's inverse weight: above 1, the mean of the prior
    is moved towards the first explanation. So a frame unlike all known ones stays as it was.
    `start` and `other` are buffers.
    """
    believed = refiner.known.believed
    if not believed[min(int(total(usable)), len(believed)) - 1] > 0:
        return
    count = len(explanation.points)
    shown, rays = np.zeros(count, np.int64), np.empty((count, 3))
    align_explanation_into(explanation, refiner.prior.means, start)
    measured, several = coverage_into(views, usable, start, shown, rays)
    if several:
        return
    prior = prior_of_neighbours(refiner.known, start.points, shown, rays)
    cost, misfit = explain_with(prior, rig, views, usable, start, other)
    share = misfit / max(measured - SIMILARITY, 1)
    if math.isfinite(cost) and share > 1.0:
        for p in range(count):
            for i in range(3):
                off = prior.means[p, i] - start.points[p, i]
                prior.means[p, i] = start.points[p, i] + off / share
        cost, _ = explain_with(prior, rig, views, usable, start, other)
    if math.isfinite(cost):
        copy_explanation(other, explanation)


@inner
def coverage_into(
    views: Views, usable: Bool, explanation: Explanation, shown: Int64, rays: Float64
) -> tuple[int, bool]:
    """Count the views that show each keypoint (P,), and write the ray of the last one (P, 3).

    Returns how many coordinates of the structure they measure, and whether several views show
    every keypoint.
    """
    measured, several = 0, True
    for p in range(len(shown)):
        for k in range(len(usable)):
            if not usable[k] or not views.weights[k, p] > 0:
                continue
            shown[p] += 1
            # The ray in the frame of the structure: R^T (R x + t).
            length = 0.0
            rotation, translation = explanation.rotations[k], explanation.translations[k]
            for i in range(3):
                rays[p, i] = explanation.points[p, i]
                for j in range(3):
                    rays[p, i] += rotation[j, i] * translation[j]
                length += rays[p, i] ** 2
            for i in range(3):
                rays[p, i] /= math.sqrt(length)
        measured += min(1 + shown[p], 3) if shown[p] else 0
        several = several and shown[p] > 1
    return measured, several
