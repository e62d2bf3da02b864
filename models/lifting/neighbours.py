"""A frame's keypoints that few views tell, as the known structures nearest to it have them."""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import SIMILARITY
from models.bundle.known_structures import NEIGHBOURS, SPREAD, prior_of_neighbours
from models.bundle.problem import Rig, Views
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
    """Explain a frame once more if few views tell some of its keypoints, about its neighbours.

    How far what views tell is from the neighbours' prior, as a share of what that expects, is how
    little the prior is believed: with shares beyond 1, its mean goes towards the explanation there
    was. A frame unlike all that is known stays as it was. `start` and `other` are room.
    """
    believed = refiner.known.believed
    if not believed[min(int(total(usable)), len(believed)) - 1] > 0:
        return
    count = len(explanation.points)
    shown, rays = np.zeros(count, np.int64), np.empty((count, 3))
    align_explanation_into(explanation, refiner.prior.means, start)
    told, several = what_is_told(views, usable, start, shown, rays)
    if several:
        return
    prior = prior_of_neighbours(refiner.known, start.points, shown, rays, NEIGHBOURS, SPREAD)
    cost, misfit = explain_with(prior, rig, views, usable, start, other)
    share = misfit / max(told - SIMILARITY, 1)
    if math.isfinite(cost) and share > 1.0:
        for p in range(count):
            for i in range(3):
                off = prior.means[p, i] - start.points[p, i]
                prior.means[p, i] = start.points[p, i] + off / share
        cost, _ = explain_with(prior, rig, views, usable, start, other)
    if math.isfinite(cost):
        copy_explanation(other, explanation)


@inner
def what_is_told(
    views: Views, usable: Bool, explanation: Explanation, shown: Int64, rays: Float64
) -> tuple[int, bool]:
    """Write how many views show each keypoint (P,), and the ray of the last that does (P, 3).

    Returns how many numbers of the structure they tell, and whether several show each keypoint.
    """
    told, several = 0, True
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
        told += min(1 + shown[p], 3) if shown[p] else 0
        several = several and shown[p] > 1
    return told, several
