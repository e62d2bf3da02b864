"""Left and right exchanged in one view: a detector names the sides of a mirror image wrongly."""

from typing import NamedTuple

import numpy as np

from models.calibrating.problem import CalibrationProblem
from models.epipolar.left_right import find_left_right
from models.epipolar.order_checks import LEAST_FRAMES
from models.epipolar.view_pairs import chosen_pairs, fit_pairs, seen_keypoints


class SidesExchanged(NamedTuple):
    """A view whose left and right keypoints were exchanged in all frames."""

    view: int
    partners: tuple[int, ...]  # (P,) with which keypoint each changes places
    problem: CalibrationProblem  # with them put back, without geometry


def exchanged_sides(problem: CalibrationProblem) -> SidesExchanged | None:
    """Return the view that shows left and right exchanged, if epipolar lines show one.

    A mirror image has epipolar lines, too, so this is seen before the mirror is.
    """
    if len(problem.weights) < LEAST_FRAMES:
        return None
    seen = seen_keypoints(problem.detected, problem.weights)
    matrices = fit_pairs(seen, chosen_pairs(seen))
    found = find_left_right(seen, matrices) if matrices else None
    if found is None or len(found.views) != 1 or not found.frames.all():
        return None
    (view,) = found.views
    partners = np.arange(problem.weights.shape[2])
    partners[seen.keypoints] = seen.keypoints[found.partners]
    keypoints, detected = problem.keypoints.copy(), problem.detected.copy()
    weights = problem.weights.copy()
    for array in (keypoints, detected, weights):
        array[:, view] = array[:, view][:, partners]
    problem = problem._replace(
        keypoints=keypoints, detected=detected, weights=weights, geometry=None
    )
    return SidesExchanged(view, tuple(partners.tolist()), problem)
