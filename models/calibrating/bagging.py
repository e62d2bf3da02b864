"""Bootstrap weights for the evidence of lens trials, whose frames are correlated.

Errors of frames are correlated, by the removal of noise and by all that a model leaves out. So the
evidence is less than the sum over frames, and other frames might have preferred another trial.
"""

import numpy as np
from numpy.typing import NDArray

from models.calibrating.problem import CalibrationProblem

Float64 = NDArray[np.float64]

RESAMPLED = 200  # times that frames are drawn with replacement


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


def share_of_information(problem: CalibrationProblem, noise: float) -> float:
    """Return the weight of keypoints with this `noise` in pixels; 1 if no noise was removed.

    Removing noise correlates the errors of many frames. If all were correlated, the weight would be
    the square of the ratio of the noise after to the noise before. On drawn rigs it is the ratio.
    """
    seen = problem.weights > 0
    removed = np.square(problem.detected - problem.keypoints)[seen].mean()
    return float(noise / np.sqrt(noise**2 + removed))
