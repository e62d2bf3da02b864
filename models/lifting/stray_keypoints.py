"""Keypoints that lie far from where the rest of their frame says, seen once it is explained.

`models.capture.outliers` leaves out what cannot be, by the image alone. What it must believe, as a
keypoint might lie there, can still be nowhere near what the other views and the structure say.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, Views
from models.capture.observations import Observations
from models.lifting.explanations import Explanation
from models.network.answers import Answers
from models.numerics.compiled import inner
from models.numerics.matrices import total
from models.optics.lenses.projection import project_into

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

STRAY = 8.0  # noise standard deviations from which a keypoint strays
LEAST_VIEWS = 3  # that show a frame: where two do, all keypoints are held by two rays alone
OF_TWO = 3.0  # times as far where two views show a keypoint, as it is not known which one is wrong
NEAR = 0.15  # share of the subject's size: so near to where all others say it is, one is right
STRAY_SHARE = 0.05  # and at least this share of the subject's size: no lens model is exact
MOST_STRAY = 0.1  # of the keypoints of a frame: where more do, the frame is explained wrongly
MOST_OF_VIEW = 0.25  # of the keypoints of a view: where more do, its camera was moved


@inner
def leave_out_stray(
    rig: Rig, views: Views, sizes: Float32, explanation: Explanation, doubted: Float64
) -> int:
    """Take the weight from keypoints that stray, in one view of each at most; says how many.

    Where two views alone show a keypoint, both lose it. Their weights are written to `doubted`
    (K, P), for `take_back`. `sizes` (K,) are those of the subject in the views, pixels. Weights are
    inverse variances of the noise.
    """
    stray: Bool = np.zeros(doubted.shape, np.bool_)
    _find_stray(rig, views, sizes, explanation, stray)
    found, all_shown = 0, 0
    for k in range(len(views.weights)):
        strays, shown = 0, 0
        for p in range(stray.shape[1]):
            shown += views.weights[k, p] > 0
            strays += stray[k, p]
        if strays > MOST_OF_VIEW * shown:
            return 0
        found += strays
        all_shown += shown
    if found > MOST_STRAY * all_shown:
        return 0
    for p in range(stray.shape[1]):
        both = total(stray[:, p]) > 1
        for k in range(len(stray)):
            doubted[k, p] = 0.0
            if stray[k, p]:
                if both:
                    doubted[k, p] = views.weights[k, p]
                views.weights[k, p] = 0.0
    return found


@inner
def take_back(
    rig: Rig, views: Views, sizes: Float32, explanation: Explanation, doubted: Float64
) -> int:
    """Give `doubted` keypoints their weight again where the explanation without them is near."""
    pixel, taken = np.empty(2), 0
    for k in range(len(doubted)):
        for p in range(doubted.shape[1]):
            if doubted[k, p] > 0:
                distance = _distance(rig, views, explanation, k, p, pixel)
                if distance < NEAR * sizes[k]:
                    views.weights[k, p] = doubted[k, p]
                    taken += 1
    return taken


@inner
def _find_stray(
    rig: Rig, views: Views, sizes: Float32, explanation: Explanation, stray: Bool
) -> None:
    """Write in which view each keypoint strays most (K, P), or in which two that alone show it."""
    views_of_frame, pixel = 0, np.empty(2)
    for k in range(len(stray)):
        views_of_frame += total(views.weights[k]) > 0
    if views_of_frame < LEAST_VIEWS:
        return
    for p in range(stray.shape[1]):
        shown = 0
        for k in range(len(stray)):
            shown += views.weights[k, p] > 0
        if shown < 2:
            continue
        worst, where = OF_TWO if shown == 2 else 1.0, -1
        for k in range(len(stray)):
            if views.weights[k, p] > 0:
                limit = max(STRAY / math.sqrt(views.weights[k, p]), STRAY_SHARE * sizes[k])
                off = _distance(rig, views, explanation, k, p, pixel) / limit
                if off > worst:
                    worst, where = off, k
        if where >= 0:
            for k in range(len(stray)):
                stray[k, p] = k == where or (shown == 2 and views.weights[k, p] > 0)


@inner
def _distance(
    rig: Rig, views: Views, explanation: Explanation, k: int, p: int, pixel: Float64
) -> float:
    """Return how far a view shows a keypoint from where the explanation has it, pixels."""
    camera = np.empty(3)
    for i in range(3):
        camera[i] = explanation.translations[k, i]
        for j in range(3):
            camera[i] += explanation.rotations[k, i, j] * explanation.points[p, j]
    project_into(camera, rig.lenses, k, pixel)
    x = pixel[0] - views.keypoints[k, p, 0]
    y = pixel[1] - views.keypoints[k, p, 1]
    return math.sqrt(x * x + y * y)


@inner
def report_stray(seen: Observations, views: Views, n: int, answers: Answers) -> None:
    """Say of frame n which keypoints were seen and have no weight any more: they are outliers."""
    for k in range(len(views.weights)):
        for p in range(views.weights.shape[1]):
            if seen.usable[n, k] and seen.weights[n, k, p] > 0 and not views.weights[k, p] > 0:
                answers.outlier_probability[n, k, p] = 1.0
                answers.keypoints_used[n, k] -= 1
                answers.keypoints_seen[n, p] -= 1
