"""What supports each keypoint: its distance from the fit, in noise, and the views that agree."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.extents import extents
from models.labelling.filmed import Filmed
from models.numerics.medians import RAYLEIGH
from models.settings.keypoints import OUTLIER

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

LEAST_NOISE = 1 / 200  # of the subject's radius in a view: no detector is better than that
FAR = 4.0  # deviations: of normal errors one in 3000 is further off


class Evidence(NamedTuple):
    """N frames of K views of P keypoints, the frames being the views' own."""

    errors: Float64  # (N, K, P) pixels between detection and reprojection; NaN without one of them
    noise: Float64  # (K, P) pixels: standard deviation of a coordinate in accepted frames
    accepted: Bool  # (N, K, P) detections that the fit agrees with
    others: Int64  # (N, K, P) how many other views accept the keypoint at that moment
    spread: Float64  # (N, K, P) root mean square of errors / noise over all views that accept it

    @property
    def deviations(self) -> Float64:
        """The errors (N, K, P), in noise."""
        return self.errors / self.noise


def weigh(filmed: Filmed) -> Evidence:
    """Return what supports each keypoint."""
    errors = np.linalg.norm(filmed.keypoints - filmed.reprojections, axis=-1)
    known = np.isfinite(errors)
    inlying = known & ~(filmed.outlier_probability > OUTLIER)
    noise = _noise(filmed, errors, inlying)
    with np.errstate(invalid="ignore"):
        accepted = inlying & (errors <= FAR * noise)
    at_moments = filmed.at_moments(accepted)
    squares = np.where(accepted, np.square(errors / noise), 0.0)
    sums = filmed.at_moments(squares)
    agreeing = at_moments.sum(1)  # (N, P)
    mean = np.sqrt(sums.sum(1) / np.maximum(agreeing, 1))
    views = errors.shape[1]
    everywhere = filmed.of_moments(np.repeat(agreeing[:, None], views, axis=1))
    spread = filmed.of_moments(np.repeat(mean[:, None], views, axis=1))
    return Evidence(errors, noise, accepted, everywhere - accepted, np.nan_to_num(spread))


def _noise(filmed: Filmed, errors: Float64, inlying: Bool) -> Float64:
    """Return the deviations (K, P) in pixels: those of a keypoint, or of its view if larger."""
    shown = np.asarray(np.isfinite(filmed.keypoints).all(-1))
    radii = extents(filmed.keypoints.astype(np.float32), shown).usual_radii
    noise = np.full(errors.shape[1:], np.nan)
    for view, within in enumerate(inlying.transpose(1, 0, 2)):
        least = LEAST_NOISE * radii[view]
        if within.any():
            of_view = np.median(errors[:, view][within]) / RAYLEIGH
            noise[view] = np.fmax(of_view, least)
        for keypoint in np.flatnonzero(within.any(0)):
            own = np.median(errors[within[:, keypoint], view, keypoint]) / RAYLEIGH
            noise[view, keypoint] = max(noise[view, keypoint], own)
    return noise
