"""Where keypoints of a fit usually lie among the others, and answers that are far from there.

Where fewer than two views see a keypoint the answer is that of the fit's shapes, whose deviations
are too small if few frames had two views. So it only counts near where two views saw the keypoint.
"""

import numpy as np
from numpy.typing import NDArray

from models.capture.metrics import procrustes_by_size
from models.lifting.lift import LiftedFrames
from models.posterior.quality import FURTHEST
from models.settings.keypoints import MIN_KEYPOINTS

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

ROUNDS = 3  # of aligning frames to what is learnt of them


def learn_usual_structure(lift: LiftedFrames, mean: Float64) -> Float32:
    """Return where keypoints (P, 3) lie by the median of the frames in which two views see them.

    NaN where there is none. The unit and the frame of reference are near those of `mean` (P, 3).
    """
    twice, usual = (lift.keypoints_seen > 1)[..., None], mean
    for _ in range(ROUNDS):
        aligned = procrustes_by_size(lift.points3d, np.where(twice, usual, np.nan))
        aligned[~twice[..., 0]] = np.nan
        known = np.isfinite(aligned).any((0, 2))
        usual = np.full_like(mean, np.nan)
        usual[known] = np.nanmedian(aligned[:, known], 0)
    return usual.astype(np.float32)


def without_unlikely(lift: LiftedFrames, usual: Float32) -> LiftedFrames:
    """Return the lift with NaN where fewer than two views see a keypoint, far from `usual` (P, 3).

    Frames in which two views see too few keypoints to align them stay as they are. `usual` may be
    (0, 3), and then all do.
    """
    twice = lift.keypoints_seen > 1  # (N, P)
    if not len(usual) or twice.all():
        return lift
    asked = (twice & np.isfinite(usual[:, 0])).sum(1) >= MIN_KEYPOINTS
    if not asked.any():
        return lift
    seen = twice[asked]
    off = procrustes_by_size(lift.points3d[asked], np.where(seen[..., None], usual, np.nan)) - usual
    radius = np.sqrt(np.nansum(np.nanvar(usual, 0)))
    unlikely = np.zeros(twice.shape, np.bool_)
    unlikely[asked] = ~seen & (np.linalg.norm(off, axis=-1) > FURTHEST * radius)
    return lift.without_points(unlikely)
