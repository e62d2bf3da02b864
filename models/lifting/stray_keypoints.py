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
from models.optics.lenses.projection import project_into

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

STRAY = 8.0  # noise standard deviations from which a keypoint strays
LEAST_VIEWS = 3  # that show a keypoint: of two it is not known which one is wrong
STRAY_SHARE = 0.05  # and at least this share of the subject's size: no lens model is exact
MOST_STRAY = 0.1  # of the keypoints of a frame: where more do, the frame is explained wrongly
MOST_OF_VIEW = 0.25  # of the keypoints of a view: where more do, its camera was moved


@inner
def leave_out_stray(rig: Rig, views: Views, sizes: Float32, explanation: Explanation) -> int:
    """Take the weight from keypoints that stray, in one view of each at most; says how many.

    `sizes` (K,) are those of the subject in the views, pixels. Weights are inverse variances of the
    noise.
    """
    stray = np.full(len(explanation.points), -1)
    _find_stray(rig, views, sizes, explanation, stray)
    found, all_shown = 0, 0
    for k in range(len(views.weights)):
        strays, shown = 0, 0
        for p in range(len(stray)):
            shown += views.weights[k, p] > 0
            strays += stray[p] == k
        if strays > MOST_OF_VIEW * shown:
            return 0
        found += strays
        all_shown += shown
    if found > MOST_STRAY * all_shown:
        return 0
    for p in range(len(stray)):
        if stray[p] >= 0:
            views.weights[stray[p], p] = 0.0
    return found


@inner
def _find_stray(
    rig: Rig, views: Views, sizes: Float32, explanation: Explanation, stray: Int64
) -> None:
    """Write the view in which each keypoint (P,) strays most; -1 stays if it strays in none."""
    camera, pixel = np.empty(3), np.empty(2)
    for p in range(len(stray)):
        shown = 0
        for k in range(len(views.weights)):
            shown += views.weights[k, p] > 0
        if shown < LEAST_VIEWS:
            continue
        worst = 1.0
        for k in range(len(views.weights)):
            if not views.weights[k, p] > 0:
                continue
            for i in range(3):
                camera[i] = explanation.translations[k, i]
                for j in range(3):
                    camera[i] += explanation.rotations[k, i, j] * explanation.points[p, j]
            project_into(camera, rig.lenses, k, pixel)
            x = pixel[0] - views.keypoints[k, p, 0]
            y = pixel[1] - views.keypoints[k, p, 1]
            limit = max(STRAY / math.sqrt(views.weights[k, p]), STRAY_SHARE * sizes[k])
            off = math.sqrt(x * x + y * y) / limit
            if off > worst:
                worst, stray[p] = off, k


@inner
def report_stray(seen: Observations, views: Views, n: int, answers: Answers) -> None:
    """Say of frame n which keypoints were seen and have no weight any more: they are outliers."""
    for k in range(len(views.weights)):
        for p in range(views.weights.shape[1]):
            if seen.usable[n, k] and seen.weights[n, k, p] > 0 and not views.weights[k, p] > 0:
                answers.outlier_probability[n, k, p] = 1.0
                answers.keypoints_used[n, k] -= 1
                answers.keypoints_seen[n, p] -= 1
