"""Denoising before any geometry: all views of a frame together lie near a low-dimensional set.

Cameras that rest see a subject whose keypoints, views stacked into one vector, have few principal
components; noise has as many as there are coordinates. Where a capture's smaller components look
like white noise, probabilistic PCA (Tipping & Bishop, 1999) tells what of a coordinate is signal.
Cameras that move spoil the low dimension, and the smaller components show it: nothing is done then.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import Observations, as_observations

Float64 = NDArray[np.float64]

MOST_FRAMES = 4000  # plenty to learn components from
MOST_NUMBERS = 2000  # coordinates of a frame
OBSERVED = 0.7  # share of its coordinates that a frame must have to be learnt from
ROUNDS = 15  # of filling what was not observed
WHITE = 1.2  # times as steep as white noise may the smaller eigenvalues fall
FAINT = 0.02  # of a view's size: less noise than that, and geometry does better


class ViewModel(NamedTuple):
    """y = mean + B z + e with z ~ N(0, 1), e ~ N(0, noise^2), of all views of a frame; pixels."""

    mean: Float64  # (K, P, 2)
    basis: Float64  # (K, P, 2, Q)
    noise: float

    @property
    def left(self) -> float:
        """The noise that denoising leaves in a coordinate, pixels."""
        flat = self.basis.reshape(self.mean.size, -1)
        signal = (flat**2).sum(0)  # of every component
        return float(self.noise * np.sqrt((signal / (signal + self.noise**2)).sum() / len(flat)))

    def denoise(self, seen: Observations, views: Sequence[int]) -> Observations:
        """Replace what was observed in `views` by its posterior mean."""
        mean, basis = self.mean[list(views)], self.basis[list(views)]
        pixels, observed = _pixels(seen)
        offset = np.where(observed[..., None], pixels - mean, 0).reshape(len(pixels), -1)
        flat = basis.reshape(offset.shape[1], -1)
        shown = np.repeat(observed.reshape(len(pixels), -1), 2, axis=1).astype(np.float64)
        products = (flat[:, :, None] * flat[:, None]).reshape(len(flat), -1)
        inner = (shown @ products).reshape(len(pixels), flat.shape[1], flat.shape[1])
        inner += self.noise**2 * np.eye(flat.shape[1])
        z = np.linalg.solve(inner, (offset @ flat)[..., None])[..., 0]
        signal = mean + (z @ flat.T).reshape(pixels.shape)
        return as_observations(np.where(observed[..., None], signal, np.nan), seen.weights)


def _pixels(seen: Observations) -> tuple[Float64, NDArray[np.bool_]]:
    pixels = seen.keypoints * seen.sizes[..., None, None] + seen.centres[..., None, :]
    return pixels.astype(np.float64), seen.weights > 0


def learn_views(seen: Observations) -> ViewModel | None:
    """Learn from a capture; None if there is no use in it.

    Noise and the number of components are told by the eigenvalues of white noise, a Gaussian
    matrix of the same shape.
    """
    keypoints, observed = _pixels(seen)
    size = float(np.median(seen.sizes[seen.usable])) if seen.usable.any() else 1.0
    views, count = keypoints.shape[1:3]
    frames = np.flatnonzero(observed.mean((1, 2)) >= OBSERVED)
    frames = frames[:: max(1, -(-len(frames) // MOST_FRAMES))]
    width = 2 * views * count
    if len(frames) < 2 * width or width > MOST_NUMBERS:
        return None
    known = np.repeat(observed[frames].reshape(len(frames), -1), 2, axis=1)
    given = np.where(known, keypoints[frames].reshape(len(frames), -1), 0)
    filled = np.where(known, given, given.sum(0) / np.maximum(known.sum(0), 1))
    white = _eigenvalues(np.random.default_rng(0).standard_normal(filled.shape))[0]
    half = slice(width // 2, None)
    for _ in range(1 if known.all() else ROUNDS):
        mean = filled.mean(0)
        values, vectors = _eigenvalues(filled - mean)
        variance = values[half].mean() / white[half].mean()
        kept = values > variance * (1 + np.sqrt(width / len(frames))) ** 2
        basis = vectors[:, kept]
        share = np.clip(1 - variance / values[kept], 0, None)
        filled = np.where(known, given, mean + ((filled - mean) @ basis * share) @ basis.T)
    near, far = int(0.55 * width), int(0.95 * width)
    if values[near] * white[far] > WHITE * values[far] * white[near]:
        return None
    if variance < (FAINT * size) ** 2 or not kept.any():
        return None
    basis = basis * np.sqrt(values[kept] - variance)
    shape = (views, count, 2)
    return ViewModel(mean.reshape(shape), basis.reshape(*shape, -1), float(np.sqrt(variance)))


def _eigenvalues(centred: Float64) -> tuple[Float64, Float64]:
    """Eigenvalues (D,), falling, and eigenvectors (D, D) of the covariance of rows (N, D)."""
    values, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    return np.maximum(values[::-1], 1e-12), vectors[:, ::-1]
