"""What a subject does again and again, told of keypoints that were smoothed in time.

Smoothing goes by the frames around, the mixture and the curves of a fit's poses by frames that
look alike. A frame, of which smoothed values and their variances are known, is taken to be
mean + x + d with x as the denoiser of the fit expects it: what that does not know, d, is white, and
as large as the frame itself shows.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.denoising import Denoiser
from models.capture.score_mixture import ScoreMixture, posterior_mean_into

Float64 = NDArray[np.float64]

# The variance of d: times what a frame shows of it, and at least times what the mixture leaves of
# the noise in frames of its fit. Frames unlike these are then left as they were smoothed.
DOUBT, LEAST_DOUBT = 2.0, 0.5


class KnownPoses(NamedTuple):
    """Poses of a fit in the D coordinates in which what is smoothed falls apart."""

    mean: Float64  # (D,)
    directions: Float64  # (D, Q) what coordinates change by with the scores
    mixture: ScoreMixture
    points: Float64  # (D, M) of curves, less the mean
    heights: Float64  # (M,) of these points
    share: float  # that curves have in what is expected
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
        """Return the mean (D,) of the points, as probable as `offsets` (D,) make them."""
        logs = self.heights + self.points.T @ (offsets / variances)
        logs -= np.square(self.points).T @ (0.5 / variances)
        belongs = np.exp(logs - logs.max())
        mean: Float64 = self.points @ belongs / belongs.sum()
        return mean


def known_poses(
    denoiser: Denoiser, views: Sequence[int], noise: Float64, basis: Float64
) -> KnownPoses:
    """Tell the poses of a fit in some of its views, in `basis` (D, D) of coordinates over `noise`.

    `noise` (D,) are their standard deviations in pixels.
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
