"""Keypoints that lie far from where the rest of their frame says, seen once it is explained.

`models.capture.outliers` leaves out what cannot be, by the image alone. What it must believe, as a
keypoint might lie there, can still be nowhere near what the other views and the structure say; and
what it left out can lie just where they say. So frames are looked at again
(`models.lifting.second_looks`).
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, Views
from models.lifting.explanations import Explanation
from models.numerics.compiled import inner
from models.numerics.matrices import total
from models.optics.lenses.projection import project_into

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int8 = NDArray[np.int8]

STRAY = 8.0  # noise standard deviations from which a keypoint strays
LEAST_VIEWS = 3  # that show a frame: where two do, all keypoints are held by two rays alone
OF_TWO = 3.0  # times as far where two views show a keypoint, as it is not known which one is wrong
NEAR = 0.15  # share of the subject's size: so near to where all others say it is, it is right
STRAY_SHARE = 0.05  # and at least this share of the subject's size: no lens model is exact
MOST_STRAY = 0.1  # of the keypoints of a frame: where more do, the frame is explained wrongly
MOST_OF_VIEW = 0.25  # of the keypoints of a view: where more do, its camera was moved

# Verdicts on what a view shows of a keypoint:
STAYS, STRAYS, RETURNS = 0, 1, 2


@inner
def look_again(
    rig: Rig,
    views: Views,
    sizes: Float32,
    left_out: Float32,
    explanation: Explanation,
    verdicts: Int8,
) -> bool:
    """Write which keypoints of a frame stray, and which return; say whether there are any.

    Parameters
    ----------
    views
        Their weights are inverse variances of the noise.
    sizes
        (K,) of the subject in the views, pixels.
    left_out
        (K, P, 3) pixels and confidences of what was left out before; confidence 0: it was not.
    verdicts
        (K, P) `STAYS`, `STRAYS` or `RETURNS`, to be written.
    """
    found = _find_stray(rig, views, sizes, explanation, verdicts)
    return found + _find_right(rig, views, sizes, left_out, explanation, verdicts) > 0


@inner
def _find_stray(
    rig: Rig, views: Views, sizes: Float32, explanation: Explanation, verdicts: Int8
) -> int:
    """Write in which view each keypoint strays most, or in which two that alone show it."""
    views_of_frame, pixel = 0, np.empty(2)
    for k in range(len(verdicts)):
        views_of_frame += total(views.weights[k]) > 0
    if views_of_frame < LEAST_VIEWS:
        return 0
    for p in range(verdicts.shape[1]):
        shown = _views_of(views, p)
        if shown < 2:
            continue
        worst, where = OF_TWO if shown == 2 else 1.0, -1
        for k in range(len(verdicts)):
            if views.weights[k, p] > 0:
                limit = max(STRAY / math.sqrt(views.weights[k, p]), STRAY_SHARE * sizes[k])
                x, y = views.keypoints[k, p]
                off = _distance(rig, explanation, k, p, x, y, pixel) / limit
                if off > worst:
                    worst, where = off, k
        if where >= 0:
            for k in range(len(verdicts)):
                if k == where or (shown == 2 and views.weights[k, p] > 0):
                    verdicts[k, p] = STRAYS
    return _unless_too_many(views, verdicts)


@inner
def _unless_too_many(views: Views, verdicts: Int8) -> int:
    """Return how many keypoints stray; where so many do that it is the explanation, none does."""
    found, all_shown, too_many = 0, 0, False
    for k in range(len(verdicts)):
        strays, seen = 0, 0
        for p in range(verdicts.shape[1]):
            seen += views.weights[k, p] > 0
            strays += verdicts[k, p] == STRAYS
        too_many |= strays > MOST_OF_VIEW * seen
        found += strays
        all_shown += seen
    if too_many or found > MOST_STRAY * all_shown:
        verdicts[:] = STAYS
        return 0
    return found


@inner
def _find_right(
    rig: Rig,
    views: Views,
    sizes: Float32,
    left_out: Float32,
    explanation: Explanation,
    verdicts: Int8,
) -> int:
    """Let keypoints return that fewer than two views tell, if they lie near where they should."""
    found, pixel = 0, np.empty(2)
    for p in range(verdicts.shape[1]):
        shown = 0
        for k in range(len(verdicts)):
            shown += views.weights[k, p] > 0 and verdicts[k, p] == STAYS
        for k in range(len(verdicts) if shown < 2 else 0):
            if left_out[k, p, 2] > 0:
                x, y = left_out[k, p, 0], left_out[k, p, 1]
                if _distance(rig, explanation, k, p, x, y, pixel) < NEAR * sizes[k]:
                    verdicts[k, p] = RETURNS
                    found += 1
    return found


@inner
def _views_of(views: Views, p: int) -> int:
    """Return how many views show a keypoint."""
    shown = 0
    for k in range(len(views.weights)):
        shown += views.weights[k, p] > 0
    return shown


@inner
def _distance(
    rig: Rig, explanation: Explanation, k: int, p: int, x: float, y: float, pixel: Float64
) -> float:
    """Return how far a pixel of a view is from where the explanation has keypoint p, pixels."""
    camera = np.empty(3)
    for i in range(3):
        camera[i] = explanation.translations[k, i]
        for j in range(3):
            camera[i] += explanation.rotations[k, i, j] * explanation.points[p, j]
    project_into(camera, rig.lenses, k, pixel)
    return math.sqrt((pixel[0] - x) ** 2 + (pixel[1] - y) ** 2)
