"""Views that show a detector's boxes about the subject, resized to one shape in every frame.

The middle of a box is that of the subject. If boxes of all proportions become images of one shape,
the subject has nearly the same width and height in all of these, too, and each is stretched in
another way. Cameras show such images only of subjects that do not move.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.medians import NORMAL

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Figures: evidence/keypoints.md.
# Set on drawn captures 0 to 23 of each kind, motions of `setting`: of 26 views that are stretched
# 23 are within both, and of 457 others 8, all of which are in boxes or static. Of `looking`: 25 of
# 25, and 9 of 454.
LIKE_SIZE = 0.13  # largest scatter of the log width, and of the log height
LIKE_PLACE = 0.075  # and of the middle, in widths and heights
MOST_HIDDEN = 0.2  # share of the keypoints: with more, extents are too small
FEWEST = 20  # frames


class Boxes(NamedTuple):
    """Which of K views show a detector's boxes."""

    shown: Bool  # (K,)
    stretched: Bool  # (K,) and whether boxes of all proportions are resized to one shape


def boxes_of(keypoints: Float64, weights: Float64) -> Boxes:
    """Return which views of keypoints (N, K, P, 2) show boxes.

    `weights` (N, K, P) are 0 where not observed.
    """
    found = Boxes(*np.zeros((2, keypoints.shape[1]), bool))
    for view in range(len(found.shown)):
        seen = weights[:, view] > 0  # (N, P)
        frames = seen.sum(1) >= (1 - MOST_HIDDEN) * seen.any(0).sum()
        frames &= seen.sum(1) > 1
        if frames.sum() < FEWEST:
            continue
        shown, seen = keypoints[frames, view], seen[frames, :, None]
        high = np.where(seen, shown, -np.inf).max(1)  # (n, 2)
        low = np.where(seen, shown, np.inf).min(1)
        extents = high - low
        if not (extents > 0).all():
            continue
        places = (high + low) / 2 / np.median(extents, 0)
        found.shown[view] = (_scatter(places) < LIKE_PLACE).all()
        alike = (_scatter(np.log(extents)) < LIKE_SIZE).all()
        found.stretched[view] = found.shown[view] and alike
    return found


def _scatter(values: Float64) -> Float64:
    """Return robust standard deviations (2,) of values (n, 2)."""
    away = np.abs(values - np.median(values, 0))
    return NORMAL * np.median(away, 0)
