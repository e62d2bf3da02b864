"""How far lifts follow the noise of keypoints, against what the posterior of a frame expects.

The posterior mean of a signal in white noise of variance s^2 has covariance s^2 dm/dy, whatever is
known of the signal: its own answer to a small change of the data (Efron, *Tweedie's formula and
selection bias*, 2011; Raphan and Simoncelli, *Least squares estimation without priors or
supervision*, 2011). A lift has more in it than a frame's posterior: noise is removed first, with
the help of other frames, and lengths and structures are known. So the response of lifts to noise
that is added to their keypoints corrects the deviations of the posterior.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from models.bundle.problem import VIEW
from models.capture.metrics import procrustes_by_size
from models.posterior.answers import derivatives_of, reprojected
from models.posterior.frames import Frames, LearntShapes, covariances_of

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

STEP = 0.3  # of the noise, that is added to it
MOST = 5.0  # times the step that a keypoint's answer may follow, for outliers that come or go
POOLED = 50.0  # keypoints in views that the correction of all points is worth in each
LEAST, MOST_CORRECTION = 0.2, 5.0
HIDDEN = 0.3  # of points
FEWEST = 20  # hidden points from which a correction is learnt
# Of a correction that makes deviations smaller, on a logarithmic scale: lifts follow noise less
# where they know more, and where their shapes are too stiff.
TRUSTED = 0.5
OF_PAIRS = 1.1  # where too stiff a shape can not be seen
OF_REMOVED = 1.15  # where noise is removed, and with it some of the motion


def white_steps(shape: tuple[int, ...], repeating: float) -> Float64:
    """Return -1 or 1 for frames (N, K, P, 2); neighbouring frames correlate by `repeating`."""
    rng = np.random.default_rng(0)
    signs = rng.choice((-1.0, 1.0), shape)
    same = rng.random(shape) < (1 + repeating) / 2
    flips = np.where(same, 1.0, -1.0)
    flips[0] = signs[0]
    return np.asarray(flips.cumprod(0))


def repetition(frames: Frames) -> float:
    """Return the correlation (0 to 0.95) of what is left of a keypoint in neighbouring frames."""
    left = frames.keypoints - reprojected(frames, frames.points)
    left = np.where((frames.weights > 0)[..., None], left, 0.0)
    together = float((left[1:] * left[:-1]).sum())
    both = (frames.weights[1:] > 0) & (frames.weights[:-1] > 0)
    alone = float((np.square(left[1:]) + np.square(left[:-1]))[both].sum()) / 2
    return min(max(together / alone, 0.0), 0.95) if alone > 0 else 0.0


def response_of(
    frames: Frames,
    moved: Frames,
    steps: Float64,
    shapes: LearntShapes,
    noise: Float64,
    *,
    removed: bool = False,
) -> Float64:
    """Return what to multiply deviations by (K + 1,), by how many views show a point.

    Where fewer than two do, this does not show it, and nothing is corrected. `removed` is whether
    noise was removed before the lift.

    Parameters
    ----------
    frames, moved
        Those of a lift, and of a lift of keypoints with `steps` (N, K, P, 2) added to them, in
        units of `STEP` times `noise` (K, P).
    """
    views = frames.weights.shape[1]
    blocks = _blocks(_uncorrected(frames), shapes)  # (N, P, 3, 3)
    derivatives, pixels = derivatives_of(frames)
    expected = np.einsum("nkpai,npij,nkpaj->nkp", derivatives, blocks, derivatives) / 2 / noise**2
    change = reprojected(moved, moved.points) - pixels
    followed = (steps * change / (STEP * noise[..., None])).clip(-MOST, MOST).mean(-1)
    shown = (frames.weights > 0) & (moved.weights > 0) & np.isfinite(expected + followed)
    number = _views_of(frames)[:, None] * np.ones((1, views, 1), int)
    out = np.ones(views + 1)
    several = shown & (number > 1)
    pool = _ratio(followed[several].sum(), expected[several].sum(), 1.0)
    for count in range(2, views + 1):
        some = shown & (number == count)
        usual = POOLED * expected[some].mean() if some.any() else 1.0
        out[count] = _ratio(followed[some].sum() + usual * pool, expected[some].sum() + usual, pool)
    out = np.sqrt(out.clip(LEAST**2, MOST_CORRECTION**2))
    out = OF_PAIRS * out.clip(1.0) if views == 2 else np.where(out < 1, out**TRUSTED, out)
    several_views = np.arange(views + 1) > 1
    return np.where(several_views, OF_REMOVED * out if removed else out, 1.0)


def hide_some(shown: Bool) -> Bool:
    """Return which keypoints (N, K, P) that two views or more show to hide, of some of the points.

    Half of these are then shown by one view, the others by none.
    """
    rng = np.random.default_rng(0)
    drawn = rng.random((len(shown), 1, shown.shape[2]))
    kept = rng.random(shown.shape) * shown
    kept = kept == kept.max(1, keepdims=True)
    several = shown.sum(1, keepdims=True) > 1
    hidden = several & ((drawn < HIDDEN / 2) | ((drawn < HIDDEN) & ~kept))
    return np.asarray(hidden & shown)


def corrections_where_hidden(frames: Frames, hidden: Frames, shapes: LearntShapes) -> Float64:
    """Return what to multiply deviations by (2,), of points that no view shows, and one view.

    `hidden` are lifts of the same frames with some keypoints hidden. Their variance is that of the
    change which all keypoints bring, and what these leave open.
    """
    number, views = _views_of(hidden), _views_of(frames)
    kept = (number == views)[..., None]
    aligned = procrustes_by_size(frames.points, np.where(kept, hidden.points, np.nan))
    changes = np.square(aligned - hidden.points).sum(-1)
    left, expected = _variances(frames, shapes), _variances(_uncorrected(hidden), shapes)
    out = np.ones(2)
    for count in (0, 1):
        some = (number == count) & (views > 1) & np.isfinite(changes + left + expected)
        if some.sum() >= FEWEST:
            # By medians, for answers of some are far off; a change is mostly along one direction.
            change = np.median(changes[some]) / chi2.ppf(0.5, 1)
            out[count] = np.sqrt((change + np.median(left[some])) / np.median(expected[some]))
    return out.clip(LEAST, MOST_CORRECTION)


def _uncorrected(frames: Frames) -> Frames:
    return frames._replace(corrections=np.ones(frames.corrections.shape))


def _blocks(frames: Frames, shapes: LearntShapes) -> Float64:
    """Return covariances (N, P, 3, 3) of points with known cameras."""
    known = np.zeros((frames.weights.shape[1], VIEW, 1))
    return covariances_of(frames, shapes, known, modes=False).blocks


def _variances(frames: Frames, shapes: LearntShapes) -> Float64:
    return np.asarray(_blocks(frames, shapes).trace(axis1=2, axis2=3))


def _views_of(frames: Frames) -> Int64:
    """Return how many views show each point (N, P)."""
    return np.asarray((frames.weights > 0).sum(1))


def _ratio(followed: float, expected: float, otherwise: float) -> float:
    return max(followed, 0.0) / expected if expected > 0 else otherwise
