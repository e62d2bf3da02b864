"""The poses of a fit as a prior for keypoints that were smoothed in time.

Smoothing uses neighbouring frames. The mixture and the curves of a fit use frames that look alike.
A smoothed frame with known variances is modelled as mean + x + d. The denoiser of the fit is the
prior of x. The deviation d from it is white, and its variance is estimated from the frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.denoising import Denoiser
from models.capture.score_mixture import ScoreMixture, posterior_mean_into

Float64 = NDArray[np.float64]

# The variance of d is `DOUBT` times the estimate from the frame, and at least `LEAST_DOUBT` times
# the noise that the mixture leaves in frames of its fit. A frame unlike these so stays as it was
# smoothed.
DOUBT, LEAST_DOUBT = 2.0, 0.5


class KnownPoses(NamedTuple):
    """Poses of a fit in the D coordinates that are smoothed independently of each other."""

    mean: Float64  # (D,)
    directions: Float64  # (D, Q) derivative of the coordinates by the scores
    mixture: ScoreMixture
    points: Float64  # (D, M) of curves, less the mean
    heights: Float64  # (M,) of these points
    share: float  # of the curves in the expectation
    least: float  # variance of d

    def combined(self, values: Float64, variances: Float64) -> Float64:
        """Return smoothed values (D,) of these variances, drawn towards the poses of the fit."""
        level = float(variances.mean())
        weighted = self.directions / (variances + level)[:, None]
        scores = np.empty(self.directions.shape[1])
        information = weighted.T @ self.directions
        posterior_mean_into(self.mixture, information, (values - self.mean) @ weighted, scores)
        expected = self.mean + self.directions @ scores
        if self.share > 0:
            on_curves = self.mean + self._expected_on_curves(values - self.mean, variances + level)
            expected += self.share * (on_curves - expected)
        off = values - expected
        unknown = max(DOUBT * (float(np.square(off).mean()) - level), self.least)
        drawn: Float64 = expected + unknown / (variances + unknown) * off
        return drawn

    def _expected_on_curves(self, offsets: Float64, variances: Float64) -> Float64:
        """Return the mean (D,) of the curves' points, weighted by probability given `offsets`."""
        logs = self.heights + self.points.T @ (offsets / variances)
        logs -= np.square(self.points).T @ (0.5 / variances)
        belongs = np.exp(logs - logs.max())
        mean: Float64 = self.points @ belongs / belongs.sum()
        return mean


def known_poses(
    denoiser: Denoiser, views: Sequence[int], noise: Float64, basis: Float64
) -> KnownPoses:
    """Return the poses of a fit in some of its views, in coordinates whitened by their noise.

    `noise` (D,) are standard deviations in pixels; `basis` (D, D) is that of the coordinates over
    them.
    """
    chosen, curves = list(views), denoiser.curves
    mean, directions = denoiser.mean[chosen], denoiser.basis[chosen]
    points = curves.points[chosen] * denoiser.noise[chosen][..., None, None]
    return KnownPoses(
        basis.T @ (mean.reshape(-1) / noise),
        basis.T @ (directions.reshape(len(noise), -1) / noise[:, None]),
        denoiser.mixture,
        basis.T @ (points.reshape(len(noise), -1) / noise[:, None]),
        curves.heights,
        curves.share,
        LEAST_DOUBT * denoiser.remaining_noise**2 / float(np.square(noise).mean()),
    )
