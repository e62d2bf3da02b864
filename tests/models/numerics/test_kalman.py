"""Smoothing against conditioning one large Gaussian, which knows nothing of time."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from models.numerics.kalman import smooth, summed_products

Float64 = NDArray[np.float64]

NOISE = 0.7
STEPS = np.array([0, 1, 0.5, 2, 1, 1, 0, 1, 3, 1, 1])  # two clips
RATES = np.array([0.3, 0.01])
UNKNOWN = 1e3  # variance of value and velocity at the start of a clip
SEEN = np.ones(len(STEPS), bool)
SEEN[[4, 9]] = False


def transitions() -> tuple[Float64, Float64]:
    """Return how states (2 N) follow from starts and forces (2 N), and these' covariance, rate 1.

    States are value and velocity; the forces of a start are the start itself.
    """
    count = len(STEPS)
    leads, covariance = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, 2 * count))
    for t, h in enumerate(STEPS):
        now, before = slice(2 * t, 2 * t + 2), slice(2 * t - 2, 2 * t)
        if h:
            leads[now] = np.array([[1, h], [0, 1]]) @ leads[before]
            covariance[now, now] = [[h**3 / 3, h**2 / 2], [h**2 / 2, h]]
        leads[now, now] += np.eye(2)
    return leads, covariance


def conditioned(numbers: Float64, rate: float) -> tuple[Float64, Float64, Float64]:
    """Return values (N,), their variances, and expected products of forces (N, 2, 2)."""
    leads, covariance = transitions()
    starts = np.repeat(STEPS == 0, 2)
    prior = rate * covariance + UNKNOWN * np.diag(starts.astype(float))
    values = leads[::2]
    seen = values[SEEN]
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + NOISE**2 * np.eye(len(seen)))
    forces = gain @ numbers[SEEN]
    left = prior - gain @ seen @ prior
    second = np.outer(forces, forces) + left
    blocks = np.stack([second[2 * t : 2 * t + 2, 2 * t : 2 * t + 2] for t in range(len(STEPS))])
    return values @ forces, np.diag(values @ left @ values.T), blocks


@pytest.fixture(scope="module")
def numbers() -> Float64:
    return np.random.default_rng(0).normal(0, 3, (2, len(STEPS)))


def test_values_and_variances_are_those_of_one_large_gaussian(numbers: Float64) -> None:
    smoothed = smooth(numbers, STEPS, SEEN, RATES, NOISE)
    for d, rate in enumerate(RATES):
        values, variances, _ = conditioned(numbers[d], rate)
        # Starts are unknown there up to a variance of a thousand, here of a billion.
        np.testing.assert_allclose(smoothed.values[d], values, atol=0.01)
        np.testing.assert_allclose(smoothed.variances[d], variances, rtol=0.01)


def test_what_rates_are_learnt_from_is_expected_squares_of_forces(numbers: Float64) -> None:
    smoothed = smooth(numbers, STEPS, SEEN, RATES, NOISE)
    squares = np.outer(RATES, RATES) * summed_products(smoothed, STEPS)
    for d, rate in enumerate(RATES):
        _, _, blocks = conditioned(numbers[d], rate)
        expected = 0.0
        for h, block in zip(STEPS, blocks, strict=True):
            if h:
                inverse = np.linalg.inv([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
                expected += float(np.trace(inverse @ block))
        assert squares[d, d] + smoothed.doubts[d].sum() == pytest.approx(expected, rel=1e-3)


def test_likelihoods_differ_as_those_of_one_large_gaussian(numbers: Float64) -> None:
    leads, covariance = transitions()
    seen, starts = leads[::2][SEEN], np.repeat(STEPS == 0, 2)
    logs = []
    for rate in RATES:
        prior = rate * covariance + UNKNOWN * np.diag(starts.astype(float))
        spread = seen @ prior @ seen.T + NOISE**2 * np.eye(len(seen))
        # A start at the first number is no news: the same is expected there, whatever it is.
        mean = np.where(np.cumsum(STEPS == 0) == 1, numbers[0, 0], numbers[0, 6])[SEEN]
        logs.append(multivariate_normal(mean, spread).logpdf(numbers[0, SEEN]))
    ours = smooth(numbers[[0, 0]], STEPS, SEEN, RATES, NOISE).likelihoods
    assert ours[0] - ours[1] == pytest.approx(logs[0] - logs[1], abs=0.05)
