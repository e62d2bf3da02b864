"""Keypoints that may be each other's left and right, from their distances to other keypoints.

The left and the right keypoint of a pair have about the same distances to all others, so their
sorted distances are alike. This holds whichever side is called left, under noise and from every
direction.
"""

import numpy as np
from numpy.typing import NDArray

from models.epipolar.view_pairs import SeenFrames
from models.numerics.sampling import evenly_spread

Float64 = NDArray[np.float64]
Partners = NDArray[np.intp]  # (P,) with which keypoint each changes places; itself if with none

FRAMES = 100  # plenty for a median
ALIKE = 0.15  # of the usual distance between keypoints: sorted distances may differ by so much


def unlikeness(seen: SeenFrames) -> Float64:
    """Return how much sorted distances of keypoints differ (P, P), relative to the usual distance.

    Infinity where two keypoints are certainly not left and right of each other.
    """
    frames, _, count = seen.there.shape
    few = seen.part(evenly_spread(frames, FRAMES))
    pixels = few.pixels.reshape(-1, count, 2)
    shown = few.there.reshape(-1, count)
    apart = np.linalg.norm(pixels[:, :, None] - pixels[:, None], axis=-1)  # (M, P, P)
    apart[~(shown[:, :, None] & shown[:, None])] = np.nan
    apart = apart[np.isfinite(apart).sum((1, 2)) > count]
    unlike = np.full((count, count), np.inf)
    if not len(apart):
        return unlike
    usual = np.nanmedian(apart, (1, 2))  # 0 where most keypoints are in one place
    apart = apart[usual > 0] / usual[usual > 0, None, None]
    known = np.isfinite(apart).any(0).all(1)  # (P,) seen at all together with every other
    if not known.any():
        return unlike
    several = np.ix_(known, known)
    distances = np.sort(np.nanmedian(apart[:, known][:, :, known], 0), 1)  # (P', P') in order
    unlike[several] = np.sqrt(np.square(distances[:, None] - distances).mean(-1))
    unlike[unlike > ALIKE] = np.inf
    np.fill_diagonal(unlike, np.inf)
    return unlike


def matched(costs: Float64) -> Partners:
    """Choose partners (P,) in the order of their costs (P, P), as far as these are finite."""
    count = len(costs)
    partners, free = np.arange(count), np.ones(count, np.bool_)
    for flat in np.argsort(np.triu(costs, 1) + np.tril(np.full_like(costs, np.inf)), axis=None):
        p, q = divmod(int(flat), count)
        if not np.isfinite(costs[p, q]) or p >= q:
            break
        if free[p] and free[q]:
            partners[[p, q]], free[[p, q]] = [q, p], False
    return partners
