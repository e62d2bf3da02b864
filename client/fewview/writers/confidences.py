"""How sure a point is, for formats of detectors, which have a confidence and no deviation."""

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation

HALF = 0.05  # of the subject's radius: so far off in one standard deviation is half sure (a guess)


def confidences_of(animation: Animation) -> NDArray[np.float64]:
    """Return (N, P) in [0, 1]: 1 / (1 + (sd / (`HALF` radius))²), 1 without a sd, 0 if missing."""
    sure = animation.seen.astype(np.float64)
    if animation.points_sd is None or not sure.any():
        return sure
    points = np.where(animation.seen[..., None], animation.points, np.nan)
    there = points[animation.seen.sum(1) > 1]
    if not len(there):
        return sure
    off = there - np.nanmean(there, axis=1, keepdims=True)
    radius = float(np.median(np.sqrt(np.nanmean((off**2).sum(-1), axis=1))))
    shares = animation.points_sd / max(HALF * radius, np.finfo(float).tiny)
    return np.where(np.isfinite(shares), sure / (1 + shares**2), sure)
