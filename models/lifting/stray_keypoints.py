"""Stray keypoints: those far from where the explanation of their frame predicts them.

`models.capture.outliers` leaves out outliers by their pixels alone, before any geometry. A keypoint
that it keeps can still be far from its projection, and one that it left out can be close to it. So
frames are judged again once they are explained (`models.lifting.second_looks`).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Views
from models.lifting.explanations import Explanation
from models.lifting.rays import distance, meet
from models.numerics.compiled import inner
from models.numerics.matrices import copy, total
from models.optics.lenses.projection import Lenses

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int8 = NDArray[np.int8]

# Figures: evidence/lifts.md.
STRAY = 8.0  # noise standard deviations from which a keypoint strays
LEAST_VIEWS = 3  # that show a frame: with two, every keypoint has two rays alone
NEAR = 0.15  # share of the subject's size: a keypoint so near to its prediction is right
AGREEING = 0.02  # share of it within which rays of two views meet,
SURE = 3.0  # or so many noise standard deviations,
ABOUT = 1.5  # at most so many sizes of the structure from the predicted keypoint
STRAY_SHARE = 0.02  # and at least this share of the subject's size: no lens model is exact
MOST_STRAY = 0.1  # of the keypoints of a frame: if more stray, the frame is explained wrongly
MOST_OF_VIEW = 0.25  # of the keypoints of a view: if more stray, its camera was moved

# Verdicts on a keypoint of a view:
STAYS, STRAYS, RETURNS = 0, 1, 2


class Explained(NamedTuple):
    """A frame and its explanation."""

    lenses: Lenses
    noise: float  # pixels, of keypoints of confidence 1
    views: Views  # weights are inverse variances of the noise
    sizes: Float32  # (K,) of the subject in the views, pixels
    # (K, P, 3) pixels and confidences of keypoints that were left out; confidence 0: it was not
    left_out: Float32
    explanation: Explanation


@inner
def look_again(frame: Explained, verdicts: Int8) -> bool:
    """Write which keypoints (K, P) of a frame stray or return; return whether any does.

    All `verdicts` must be `STAYS` before.
    """
    return _find_stray(frame, verdicts) + _find_right(frame, verdicts) > 0


@inner
def _find_stray(frame: Explained, verdicts: Int8) -> int:
    """Mark each keypoint that strays in its worst view, or in both if only two show it."""
    weights, views_of_frame = frame.views.weights, 0
    for k in range(len(verdicts)):
        views_of_frame += total(weights[k]) > 0
    if views_of_frame < LEAST_VIEWS:
        return 0
    for p in range(verdicts.shape[1]):
        shown = _views_of(frame, verdicts, p)
        if shown < 2:
            continue
        worst, where = 1.0, -1
        for k in range(len(verdicts)):
            if weights[k, p] > 0:
                limit = max(STRAY / math.sqrt(weights[k, p]), STRAY_SHARE * frame.sizes[k])
                x, y = frame.views.keypoints[k, p]
                off = _distance(frame, k, frame.explanation.points[p], x, y) / limit
                if off > worst:
                    worst, where = off, k
        if where >= 0:
            for k in range(len(verdicts)):
                if k == where or (shown == 2 and weights[k, p] > 0):
                    verdicts[k, p] = STRAYS
    return _unless_too_many(weights, verdicts)


@inner
def _unless_too_many(weights: Float64, verdicts: Int8) -> int:
    """Return how many keypoints stray; if so many that the explanation is wrong, clear them."""
    found, all_shown, too_many = 0, 0, False
    for k in range(len(verdicts)):
        strays, seen = 0, 0
        for p in range(verdicts.shape[1]):
            seen += weights[k, p] > 0
            strays += verdicts[k, p] == STRAYS
        too_many |= strays > MOST_OF_VIEW * seen
        found += strays
        all_shown += seen
    if too_many or found > MOST_STRAY * all_shown:
        verdicts[:] = STAYS
        return 0
    return found


@inner
def _find_right(frame: Explained, verdicts: Int8) -> int:
    """Mark left-out keypoints as returning where fewer than two views show the keypoint.

    One returns if it lies near its prediction, or if the rays of two views meet.
    """
    found, point = 0, np.empty(3)
    for p in range(verdicts.shape[1]):
        shown, there = _views_of(frame, verdicts, p), 0
        for k in range(len(verdicts)):
            there += frame.left_out[k, p, 2] > 0
        if shown > 1 or not there:
            continue
        copy(frame.explanation.points[p], point)
        returning = _return_at(frame, p, point, NEAR, 0.0, verdicts)
        if not returning and shown + there > 1 and _meet_near(frame, p, verdicts, point):
            returning = _return_at(frame, p, point, AGREEING, SURE, verdicts)
        found += returning
    return found


@inner
def _return_at(
    frame: Explained, p: int, point: Float64, share: float, noises: float, verdicts: Int8
) -> int:
    """Mark keypoint p as returning in the views that show it at a point (3,); return how many."""
    found = 0
    for k in range(len(verdicts)):
        x, y, confidence = frame.left_out[k, p]
        if confidence > 0 and _distance(frame, k, point, x, y) < _limit(
            frame, k, confidence, share, noises
        ):
            verdicts[k, p] = RETURNS
            found += 1
    return found


@inner
def _meet_near(frame: Explained, p: int, verdicts: Int8, out: Float64) -> bool:
    """Find the point (3,) where rays of two views to keypoint p meet best, if it is plausible."""
    explained, views, best = frame.explanation.points, frame.views, 1.0
    seen, places, point = frame.left_out[:, p].copy(), np.empty((2, 2)), np.empty(3)
    for k in range(len(seen)):
        if views.weights[k, p] > 0 and verdicts[k, p] == STAYS:
            seen[k, 0], seen[k, 1] = views.keypoints[k, p]
            seen[k, 2] = views.weights[k, p] * frame.noise**2
    about = ABOUT * _size(explained)
    for a in range(len(seen)):
        for b in range(a):
            if not (seen[a, 2] > 0 and seen[b, 2] > 0):
                continue
            for i in range(2):
                places[0, i], places[1, i] = seen[a, i], seen[b, i]
            copy(explained[p], point)
            off = meet(frame.lenses, frame.explanation, a, b, places, point) / min(
                _limit(frame, a, seen[a, 2], AGREEING, SURE),
                _limit(frame, b, seen[b, 2], AGREEING, SURE),
            )
            away = 0.0
            for i in range(3):
                away += (point[i] - explained[p, i]) ** 2
            if off < best and away < about**2:
                best = off
                copy(point, out)
    return best < 1.0


@inner
def _limit(frame: Explained, k: int, confidence: float, share: float, noises: float) -> float:
    """Return a share of the subject's size, or noise standard deviations if they are more."""
    limit: float = max(share * frame.sizes[k], noises * frame.noise / math.sqrt(confidence))
    return limit


@inner
def _distance(frame: Explained, k: int, point: Float64, x: float, y: float) -> float:
    return distance(frame.lenses, frame.explanation, k, point, x, y)


@inner
def _size(points: Float64) -> float:
    """Return the root mean square distance of points (P, 3) to their middle."""
    squared, count = 0.0, len(points)
    for i in range(3):
        middle = 0.0
        for p in range(count):
            middle += points[p, i] / count
        for p in range(count):
            squared += (points[p, i] - middle) ** 2 / count
    return math.sqrt(squared)


@inner
def _views_of(frame: Explained, verdicts: Int8, p: int) -> int:
    """Return how many views show a keypoint that does not stray."""
    shown = 0
    for k in range(len(verdicts)):
        shown += frame.views.weights[k, p] > 0 and verdicts[k, p] == STAYS
    return shown
