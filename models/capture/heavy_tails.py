"""Noise that is large now and then: Student's t, of both coordinates of a keypoint together."""

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner

Float64 = NDArray[np.float64]

# Noise is Student's t if it has at most so many degrees of freedom, else Gaussian. They are found
# from the ratio between the error that one in forty exceeds and the median.
MOST_DEGREES, LARGE = 12, 0.975
ROUNDS_OF_TAILS = 4  # of a frame, if its noise has heavy tails


def learn_tails(errors: Float64) -> float:
    """Return one over the degrees of freedom of keypoints' squared errors; 0 if Gaussian.

    Half the square of a keypoint's error has the distribution F(2, degrees).
    """
    median = np.quantile(errors, 0.5)
    if median <= 0:  # most keypoints have no noise at all
        return 0.0
    ratio = np.quantile(errors, LARGE) / median
    degrees = np.arange(3, 3 * MOST_DEGREES)
    large, half = ((1 - share) ** (-2 / degrees) - 1 for share in (LARGE, 0.5))
    found = degrees[np.abs(large / half - ratio).argmin()]
    return 1 / float(found) if found <= MOST_DEGREES else 0.0


@inner
def clip_into(offsets: Float64, expected: Float64, tails: float, out: Float64) -> None:
    """Write the offsets (D,) with their heavy tails cut off, given their expectation (D,).

    Both are in standard deviations of the noise, x and y of a keypoint one after the other. An
    offset further from its expectation than Gaussian noise would be is drawn in (modified
    residuals: Huber and Ronchetti, *Robust Statistics*, 2009, 7.8).
    """
    for p in range(len(offsets) // 2):
        squared = 0.0
        for d in range(2 * p, 2 * p + 2):
            squared += (offsets[d] - expected[d]) ** 2
        share = min((1.0 + 2.0 * tails) / (1.0 + squared * tails), 1.0)
        for d in range(2 * p, 2 * p + 2):
            out[d] = offsets[d] - (1.0 - share) * (offsets[d] - expected[d])


@compiled
def clip_frames_into(offsets: Float64, expected: Float64, tails: float, out: Float64) -> None:
    """Write frames (N, D), each as `clip_into` does."""
    for n in range(len(offsets)):
        clip_into(offsets[n], expected[n], tails, out[n])
