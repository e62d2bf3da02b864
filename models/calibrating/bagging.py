"""How far the evidence of trials is believed.

Errors of frames are correlated, by the removal of noise and by all that a model leaves out. So the
evidence is less than the sum over frames, and other frames might have preferred another trial.
"""

import numpy as np
from numpy.typing import NDArray

from models.calibrating.problem import CalibrationProblem

Float64 = NDArray[np.float64]

RESAMPLED = 200  # times that frames are drawn with replacement
# Squared distance of two numbers from usual ones, in their deviations. A fortieth of all distances
# are larger (chi-squared, two degrees of freedom).
FAR_OFF = 7.38
BISECTIONS = 60


def filled(evidence: Float64) -> Float64:
    """Return the evidence (T, N) of trials without NaN.

    A frame that a trial cannot explain is as unlikely as under the worst of the others.
    """
    worst = np.where(np.isfinite(evidence), evidence, np.inf).min(0)
    worst[np.isinf(worst)] = 0
    return np.where(np.isfinite(evidence), evidence, worst)


def bagged_shares(evidence: Float64, log_prior: Float64, widths: Float64 | float = 1.0) -> Float64:
    """Return posterior probabilities (T,) of trials with log evidence (T, N) of frames.

    They are means over frames drawn with replacement, because errors of frames are correlated
    (Huggins and Miller, *Robust inference and model criticism using bagged posteriors*, 2019). So
    they spread over several peaks. `widths` (T,) are the shares of the range of each trial.
    """
    rng, frames = np.random.default_rng(0), evidence.shape[1]
    shares = np.zeros(len(evidence))
    for _ in range(RESAMPLED):
        counts = np.bincount(rng.integers(frames, size=frames), minlength=frames)
        logs = evidence @ counts + log_prior
        densities = widths * np.exp(logs - logs.max())
        shares += densities / densities.sum()
    return shares / RESAMPLED


def at_most(information: Float64, widest: Float64) -> Float64:
    """Limit information (n, n): no direction has less variance than under a covariance (n, n).

    `widest` is positive definite. In the axes that make both matrices diagonal, each variance is
    the larger of the two.
    """
    root = np.linalg.cholesky(widest)
    known, axes = np.linalg.eigh(root.T @ information @ root)
    back = np.linalg.solve(root.T, axes)
    return np.asarray((back * np.minimum(known, 1.0)) @ back.T)


def reconciled(information: Float64, off: Float64, usual: Float64) -> Float64:
    """Limit information (2, 2) on two numbers whose estimates are `off` (2,) the usual ones.

    Far off these it is likelier that the evidence misleads. `usual` (2, 2) is the covariance of
    true numbers. Both estimates get as much more variance as makes the distance unsurprising (Paule
    and Mandel, *Consensus values and weighting factors*, 1982).
    """
    covariance = np.linalg.inv(information)

    def surprising(variance: float) -> bool:
        both = covariance + usual + variance * np.eye(2)
        return float(off @ np.linalg.solve(both, off)) > FAR_OFF

    low, high = 0.0, float(off @ off)
    for _ in range(BISECTIONS if surprising(0.0) else 0):
        middle = (low + high) / 2
        low, high = (middle, high) if surprising(middle) else (low, middle)
    return np.asarray(np.linalg.inv(covariance + low * np.eye(2)), np.float64)


def share_of_information(problem: CalibrationProblem, noise: float) -> float:
    """Return the weight of keypoints with this `noise` in pixels; 1 if no noise was removed.

    Removing noise correlates the errors of many frames. If all were correlated, the weight would be
    the square of the ratio of the noise after to the noise before. On drawn rigs it is the ratio.
    """
    seen = problem.weights > 0
    removed = np.square(problem.detected - problem.keypoints)[seen].mean()
    return float(noise / np.sqrt(noise**2 + removed))
