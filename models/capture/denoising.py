"""Denoising before any geometry: all views of a frame together lie near a low-dimensional set.

Cameras that rest see a subject whose keypoints, views stacked into one vector, have few principal
components; noise has as many as there are coordinates. Where a capture's smaller components look
like white noise, probabilistic PCA (Tipping & Bishop, 1999) tells what of a coordinate is signal,
and a mixture of Gaussians what the signals of a capture are like. Cameras that move spoil the low
dimension, and the smaller components show it: nothing is done then.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.capture.observations import Observations, as_observations, pixels_of
from models.capture.score_mixture import (
    ScoreMixture,
    learn_mixture,
    posterior_means_into,
    standard_normal,
)
from models.numerics.eigenvalues import falling_eigenvalues, white_eigenvalues
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import in_slices

Float64 = NDArray[np.float64]

FRAMES_AT_A_TIME = 64  # that a thread denoises
LEAST_FRAMES = 40  # with fewer, noise and signal are hardly told apart
MOST_FRAMES = 4000  # plenty to learn components from
MOST_COORDINATES = 2000  # of a frame: the covariance has as many rows
OBSERVED_SHARE = 0.7  # of its coordinates that a frame must have to be learnt from
FILLING_ROUNDS = 15  # of filling what was not observed
# Noise is white if the eigenvalues between these places, as shares of all, fall no more than so
# many times as steeply as those of white noise.
TAIL_START, TAIL_END, MOST_STEEPNESS = 0.55, 0.95, 1.2
UNLIKE = 2.0  # standard errors by which a frame must lie further off than noise explains
LEAST_NOISE = 0.02  # of a view's size: with less noise than that, geometry does better alone


class Denoiser(NamedTuple):
    """y = mean + B z + e with z ~ mixture, e ~ N(0, noise^2), of all views of a frame; pixels."""

    mean: Float64  # (K, P, 2)
    basis: Float64  # (K, P, 2, Q)
    noise: float
    mixture: ScoreMixture

    @property
    def remaining_noise(self) -> float:
        """The noise that denoising leaves in a coordinate, pixels."""
        flat = self.basis.reshape(self.mean.size, -1)  # (D, Q)
        inner = flat.T @ flat
        left = np.linalg.inv(self.mixture.precisions + inner / self.noise**2)  # (M, Q, Q)
        size = (left * inner).sum((1, 2))  # (M,)
        determinants = np.linalg.slogdet(self.mixture.precisions).logabsdet
        shares = np.exp(self.mixture.heights - determinants / 2)
        return float(np.sqrt(size @ shares / shares.sum() / len(flat)))

    def denoise(self, observations: Observations, views: Sequence[int]) -> Observations:
        """Replace what was observed in `views` (of the fit) by its expectation."""
        mean, basis = self.mean[list(views)], self.basis[list(views)]
        pixels, observed = pixels_of(observations)
        rows = (len(pixels), mean.size)
        offsets = np.where(observed[..., None], pixels - mean, 0).reshape(rows)  # (N, D)
        shown = np.repeat(observed.reshape(len(pixels), -1), 2, axis=1)
        flat = np.ascontiguousarray(basis.reshape(mean.size, -1))  # (D, Q)
        scores = np.empty((len(pixels), flat.shape[1]))

        def denoise_part(part: slice) -> None:
            posterior_means_into(
                self.mixture, flat, self.noise, offsets[part], shown[part], scores[part]
            )

        in_slices(len(pixels), FRAMES_AT_A_TIME, denoise_part)
        signal = mean + (scores @ flat.T).reshape(pixels.shape)
        kept = pixels - (1 - self._unknown_share(pixels - signal, observed)) * (pixels - signal)
        return as_observations(np.where(observed[..., None], kept, np.nan), observations.weights)

    def _unknown_share(self, removed: Float64, observed: NDArray[np.bool_]) -> Float64:
        """Of what would be removed (N, K, P, 2) from frames, the share that is no noise.

        A frame unlike those of the fit lies further from its expectation than noise explains. The
        rest is what the mixture does not know of it: (N, 1, 1, 1), 0 where noise explains all.
        """
        count = 2 * observed.sum((1, 2)).clip(1)  # (N,)
        squares = np.where(observed[..., None], np.square(removed), 0).sum((1, 2, 3)) / count
        variance = self.noise**2
        unlike = squares > variance * (1 + UNLIKE * np.sqrt(2 / count))
        unknown = np.where(unlike, squares - variance, 0)
        share: Float64 = unknown / (variance + unknown)
        return share.reshape(-1, 1, 1, 1)

    def to_arrays(self) -> Arrays:
        """Return the denoiser as tensors, for a file."""
        parts: dict[str, ArrayLike] = {"mean": self.mean, "basis": self.basis, "noise": self.noise}
        return as_tensors(parts | self.mixture._asdict())

    @classmethod
    def shapes(cls, keypoints: int, *, mixture: bool) -> Shapes:
        """Shapes of what `to_arrays` returns, for P keypoints; None stands for any length.

        Older versions knew no `mixture` but probabilistic PCA.
        """
        shapes: Shapes = {
            "mean": (None, keypoints, 2),
            "basis": (None, keypoints, 2, None),
            "noise": (1,),
        }
        if mixture:
            shapes |= {
                "heights": (None,),
                "centres": (None, None),
                "precisions": (None, None, None),
            }
        return shapes

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Denoiser":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        mean, basis = arrays["mean"].numpy(), arrays["basis"].numpy()
        noise, size = arrays["noise"].item(), basis.shape[-1]
        mixture = standard_normal(size)
        if "heights" in arrays:
            mixture = ScoreMixture(*(arrays[name].numpy() for name in ScoreMixture._fields))
        count = len(mixture.heights)
        fits = (
            mixture.centres.shape == (count, size)
            and mixture.precisions.shape == (count, size, size)
            and count > 0
            and bool((np.linalg.eigvalsh(mixture.precisions) > 0).all())
        )
        if len(mean) != len(basis) or not noise > 0 or not fits:
            raise WeightsError("the file contradicts itself about the noise")
        return cls(mean, basis, noise, mixture)


def learn_denoiser(observations: Observations) -> Denoiser | None:
    """Learn from a capture; None if there is no use in it.

    Noise and the number of components are told by the eigenvalues of white noise, a Gaussian
    matrix of the same shape.
    """
    keypoints, observed = pixels_of(observations)
    usable = observations.usable
    size = float(np.median(observations.sizes[usable])) if usable.any() else 1.0
    views, count = keypoints.shape[1:3]
    frames = np.flatnonzero(observed.mean((1, 2)) >= OBSERVED_SHARE)
    frames = frames[:: max(1, -(-len(frames) // MOST_FRAMES))]
    width = 2 * views * count  # D
    if len(frames) < LEAST_FRAMES or width > MOST_COORDINATES:
        return None
    known = np.repeat(observed[frames].reshape(len(frames), -1), 2, axis=1)  # (N, D)
    given = np.where(known, keypoints[frames].reshape(len(frames), -1), 0)
    filled = np.where(known, given, given.sum(0) / np.maximum(known.sum(0), 1))
    white = white_eigenvalues(*filled.shape)  # (D,)
    rank = min(len(frames) - 1, width)
    half = slice(rank // 2, rank)
    for _ in range(1 if known.all() else FILLING_ROUNDS):
        mean = filled.mean(0)
        values, vectors = falling_eigenvalues(filled - mean)
        variance = values[half].mean() / white[half].mean()
        kept = values > variance * (1 + np.sqrt(width / len(frames))) ** 2
        basis = vectors[:, kept]
        share = np.clip(1 - variance / values[kept], 0, None)
        filled = np.where(known, given, mean + ((filled - mean) @ basis * share) @ basis.T)
    start, end = int(TAIL_START * rank), int(TAIL_END * rank)
    if values[start] * white[end] > MOST_STEEPNESS * values[end] * white[start]:
        return None
    if variance < (LEAST_NOISE * size) ** 2 or not kept.any():
        return None
    shape, noise = (views, count, 2), float(np.sqrt(variance))
    mixture = learn_mixture((filled - mean) @ basis, noise)
    return Denoiser(mean.reshape(shape), basis.reshape(*shape, -1), noise, mixture)
