"""A mixture of Gaussians over the scores of frames: what a subject does again and again.

A frame is predicted best by frames that look like it, so a mixture of many Gaussians removes more
noise than one Gaussian for all frames. It is learnt by expectation maximisation from scores whose
noise is known and white (Dempster, Laird & Rubin, 1977). The order of the frames is not used.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.heavy_tails import ROUNDS_OF_TAILS, clip_into
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, cholesky_solve

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# How many frames a component has, on average: two answers, several random starts of each. All
# their components together are one mixture, which errs less than any of its parts.
FRAMES_PER_COMPONENT, STARTS = (46, 23), 2
# Figures: evidence/noise.md.
ROUNDS = 20
POOLED_FRAMES = 100  # that the covariance of all components together counts for in each
LEAST_SIGNAL = 1e-4  # variance of a component in any direction, as a share of that of the noise


class ScoreMixture(NamedTuple):
    """M Gaussians over Q scores."""

    heights: Float64  # (M,) log densities at the centres, up to a constant they share
    centres: Float64  # (M, Q)
    precisions: Float64  # (M, Q, Q) inverse covariances


def standard_normal(size: int) -> ScoreMixture:
    """Return the one Gaussian of probabilistic PCA, whose Q scores have variance 1."""
    return ScoreMixture(np.zeros(1), np.zeros((1, size)), np.eye(size)[None])


def learn_mixture(scores: Float64, noise: float) -> ScoreMixture:
    """Learn the distribution of scores (N, Q) without white noise of that standard deviation."""
    parts = [
        _learn(scores, noise**2, max(1, len(scores) // frames), np.random.default_rng([frames, i]))
        for frames in FRAMES_PER_COMPONENT
        for i in range(STARTS)
    ]
    shares, centres, covariances = (np.concatenate(field) for field in zip(*parts, strict=True))
    values, vectors = np.linalg.eigh(covariances)
    signal = np.maximum(values - noise**2, LEAST_SIGNAL * noise**2)
    precisions = (vectors / signal[:, None]) @ vectors.mT
    heights = np.log(shares / len(parts)) - np.log(signal).sum(1) / 2
    return ScoreMixture(heights, centres, precisions)


def degrees_of_freedom(mixture: ScoreMixture, scores: Float64, noise: float) -> float:
    """Return the degrees of freedom of a frame's expectation: how much of its noise it keeps.

    This is the mean divergence of the expected scores with respect to the scores (N, Q), whose
    noise is white: their covariance over the variance of the noise, plus the part due to learning
    the centres from the same frames.
    """
    size, logs, gains = scores.shape[1], [], []
    signals = np.linalg.inv(mixture.precisions)
    for height, centre, signal in zip(mixture.heights, mixture.centres, signals, strict=True):
        seen = np.linalg.inv(signal + noise**2 * np.eye(size))
        offset = scores - centre
        shrinking = np.linalg.slogdet(signal @ seen).logabsdet / 2
        logs.append(height + shrinking - ((offset @ seen) * offset).sum(1) / 2)
        gains.append(signal @ seen)
    belongs = np.exp(np.array(logs) - np.max(logs, axis=0))  # (M, N)
    belongs /= belongs.sum(0)
    mean, squares = np.zeros_like(scores), np.zeros(len(scores))
    for share, centre, gain in zip(belongs, mixture.centres, gains, strict=True):
        answer = centre + (scores - centre) @ gain.T
        mean += share[:, None] * answer
        squares += share * np.square(answer).sum(1)
    kept = np.trace(gains, axis1=1, axis2=2) @ belongs
    kept += (squares - np.square(mean).sum(1)) / noise**2
    kept += size * (np.square(belongs) / (belongs.sum(1, keepdims=True) + 1e-9)).sum(0)
    return float(kept.mean())


def _learn(
    scores: Float64, variance: float, count: int, random: np.random.Generator
) -> tuple[Float64, Float64, Float64]:
    """Return shares (M,), centres (M, Q) and covariances (M, Q, Q), these with the noise."""
    centres = _spread_out(scores, count, random)
    nearest = np.square(scores[:, None] - centres).sum(-1).argmin(1)
    belongs = np.eye(count)[nearest]  # (N, M)
    for _ in range(ROUNDS):
        frames = belongs.sum(0) + 1e-9
        centres = belongs.T @ scores / frames[:, None]
        scatters = np.stack(
            [
                (offset * weight[:, None]).T @ offset
                for offset, weight in (
                    (scores - c, w) for c, w in zip(centres, belongs.T, strict=True)
                )
            ]
        )
        pooled = POOLED_FRAMES * scatters.sum(0) / len(scores)
        values, vectors = np.linalg.eigh(
            (scatters + pooled) / (frames + POOLED_FRAMES)[:, None, None]
        )
        values = values.clip(variance * (1 + LEAST_SIGNAL))
        logs = np.stack(
            [
                math.log(share) - (np.square((scores - c) @ axes) / v + np.log(v)).sum(1) / 2
                for share, c, axes, v in zip(
                    frames / len(scores), centres, vectors, values, strict=True
                )
            ],
            axis=1,
        )
        belongs = np.exp(logs - logs.max(1, keepdims=True))
        belongs /= belongs.sum(1, keepdims=True)
    return frames / len(scores), centres, (vectors * values[:, None]) @ vectors.mT


def _spread_out(scores: Float64, count: int, random: np.random.Generator) -> Float64:
    """Draw scores (M, Q) far from each other (k-means++, Arthur & Vassilvitskii, 2007)."""
    centres = scores[random.integers(len(scores), size=1)]
    distances = np.square(scores - centres[0]).sum(1)
    while len(centres) < count:
        total = distances.sum()
        drawn = random.choice(len(scores), p=distances / total if total > 0 else None)
        centres = np.concatenate((centres, scores[[drawn]]))
        distances = np.minimum(distances, np.square(scores - scores[drawn]).sum(1))
    return centres


@compiled
def posterior_means_into(
    mixture: ScoreMixture,
    basis: Float64,
    offsets: Float64,
    observed: Bool,
    tails: float,
    out: Float64,
) -> None:
    """Write the expected scores (N, Q) of frames of which a part is observed.

    Noise with heavy tails is taken into account as by `clip_into`, a few times over.

    Parameters
    ----------
    basis
        (D, Q) what coordinates change by with the scores, in standard deviations of their noise.
    offsets, observed
        (N, D) coordinates minus their mean, in the same units, and whether they were observed; x
        and y of a keypoint come one after the other.
    tails
        One over the degrees of freedom of the noise; 0 if it is Gaussian.
    """
    count, size = mixture.centres.shape
    inner_products, factors = np.empty((size, size)), np.empty((count, size, size))
    shifts, logs, weighted = np.empty((count, size)), np.empty(count), np.empty(size)
    determinants, energies = np.empty(count), np.empty(count)
    expected = np.empty(len(basis))
    _weigh_centres(mixture, shifts, energies)
    for n in range(len(offsets)):
        if n == 0 or not _same(observed[n], observed[n - 1]):
            _information_into(basis, observed[n], inner_products)
            for m in range(count):
                determinants[m] = _factorise(mixture.precisions[m], inner_products, factors[m])
        clipped = offsets[n].copy()
        for i in range(ROUNDS_OF_TAILS if tails > 0.0 else 1):
            if i > 0:
                for d in range(len(basis)):
                    expected[d] = 0.0
                    for j in range(size):
                        expected[d] += basis[d, j] * out[n, j]
                clip_into(offsets[n], expected, tails, clipped)
            for j in range(size):
                weighted[j] = 0.0
            for d in range(len(basis)):
                if observed[n, d]:
                    for j in range(size):
                        weighted[j] += basis[d, j] * clipped[d]
            _mix(mixture, factors, determinants, shifts, energies, weighted, logs, out[n])


@compiled
def posterior_mean_into(
    mixture: ScoreMixture, information: Float64, weighted: Float64, out: Float64
) -> None:
    """Compute the expected scores (Q,) given a Gaussian measurement of them.

    Parameters
    ----------
    information, weighted
        (Q, Q) inverse covariance of the measurement, and (Q,) that times its mean.
    """
    count, size = mixture.centres.shape
    factors, shifts = np.empty((count, size, size)), np.empty((count, size))
    logs, determinants, energies = np.empty(count), np.empty(count), np.empty(count)
    _weigh_centres(mixture, shifts, energies)
    for m in range(count):
        determinants[m] = _factorise(mixture.precisions[m], information, factors[m])
    _mix(mixture, factors, determinants, shifts, energies, weighted, logs, out)


@inner
def _weigh_centres(mixture: ScoreMixture, shifts: Float64, energies: Float64) -> None:
    """Write the centres times their precisions (M, Q), and these times the centres (M,)."""
    count, size = mixture.centres.shape
    for m in range(count):
        energies[m] = 0.0
        for i in range(size):
            shifts[m, i] = 0.0
            for j in range(size):
                shifts[m, i] += mixture.precisions[m, i, j] * mixture.centres[m, j]
            energies[m] += shifts[m, i] * mixture.centres[m, i]


@inner
def _same(a: Bool, b: Bool) -> bool:
    different = 0
    for i in range(len(a)):
        different += a[i] != b[i]
    return different == 0


@inner
def _information_into(basis: Float64, observed: Bool, out: Float64) -> None:
    """Compute the lower half of the information (Q, Q) of observed coordinates on the scores."""
    size = basis.shape[1]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for d in range(len(basis)):
                if observed[d]:
                    total += basis[d, i] * basis[d, j]
            out[i, j] = total


@inner
def _factorise(precision: Float64, information: Float64, out: Float64) -> float:
    """Factorise their sum; return the log of its determinant, halved."""
    for i in range(len(out)):
        for j in range(i + 1):
            out[i, j] = precision[i, j] + information[i, j]
    cholesky(out)
    result = 0.0
    for i in range(len(out)):
        result += math.log(out[i, i])
    return result


@inner
def _mix(
    mixture: ScoreMixture,
    factors: Float64,
    determinants: Float64,
    shifts: Float64,
    energies: Float64,
    weighted: Float64,
    logs: Float64,
    out: Float64,
) -> None:
    """Compute the mean of the components' answers, weighted by probability given the frame."""
    count, size = shifts.shape
    means = np.empty((count, size))
    for m in range(count):
        for i in range(size):
            means[m, i] = shifts[m, i] + weighted[i]
        cholesky_solve(factors[m], means[m])
        logs[m] = mixture.heights[m] - determinants[m] - energies[m] / 2
        for i in range(size):
            logs[m] += means[m, i] * (shifts[m, i] + weighted[i]) / 2
    most, total = logs.max(), 0.0
    for i in range(size):
        out[i] = 0.0
    for m in range(count):
        share = math.exp(logs[m] - most)
        total += share
        for i in range(size):
            out[i] += share * means[m, i]
    for i in range(size):
        out[i] /= total
