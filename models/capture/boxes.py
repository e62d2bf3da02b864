"""Views that show a detector's boxes about the subject, resized to one shape in every frame.

A box is as wide and as high as the subject is in its frame. So if boxes of all proportions become
images of one shape, the subject has nearly the same place, width and height in all of these, and
each is stretched in another way. Cameras show such images only of subjects that do not move.
"""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Set on drawn captures 0 to 23 of each kind, motions of `setting`: of 26 views that are stretched
# 23 are within both, and of 457 others 8, all of which are in boxes or static. Of `looking`: 25 of
# 25, and 9 of 454.
LIKE_SIZE = 0.13  # largest scatter of the log width, and of the log height
LIKE_PLACE = 0.075  # and of the middle, in widths and heights
MOST_HIDDEN = 0.2  # share of the keypoints: with more, extents are too small
FEWEST = 20  # frames
TO_SD = 1.4826  # standard deviations of a Gaussian in its median absolute deviation


def stretched_views(keypoints: Float64, weights: Float64) -> Bool:
    """Return which views (K,) show boxes of keypoints (N, K, P, 2) that are stretched.

    `weights` (N, K, P) are 0 where not observed.
    """
    found = np.zeros(keypoints.shape[1], bool)
    for view in range(len(found)):
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
        scatters = _scatter(np.log(extents)), _scatter(places)
        found[view] = (scatters[0] < LIKE_SIZE).all() and (scatters[1] < LIKE_PLACE).all()
    return found


def _scatter(values: Float64) -> Float64:
    """Return robust standard deviations (2,) of values (n, 2)."""
    away = np.abs(values - np.median(values, 0))
    return TO_SD * np.median(away, 0)
