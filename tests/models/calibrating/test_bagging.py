"""How likely trials are to be the best, where this is known."""

import numpy as np
import pytest
from scipy.stats import norm

from models.calibrating.bagging import bagged_shares, filled


def test_frames_that_all_agree_leave_the_posterior() -> None:
    evidence = np.array([[0.0] * 8, [-0.1] * 8, [-0.4] * 8])
    expected = np.exp([0.0, -0.8 - 0.5, -3.2])
    shares = bagged_shares(evidence, np.array([0.0, -0.5, 0.0]))
    np.testing.assert_allclose(shares, expected / expected.sum(), rtol=1e-9)


def test_frames_that_disagree_leave_doubt() -> None:
    """With large differences the share is the probability that a sum of drawn frames is above 0."""
    gains = 20 * np.random.default_rng(1).standard_normal(100) + 2
    shares = bagged_shares(np.stack((gains, np.zeros(100))), np.zeros(2))
    expected = norm.cdf(gains.sum() / (gains.std() * np.sqrt(100)))
    assert 0.6 < expected < 0.95
    assert shares[0] == pytest.approx(expected, abs=0.1)


def test_what_a_trial_cannot_explain_is_as_unlikely_as_under_the_worst() -> None:
    evidence = np.array([[1.0, np.nan, np.nan], [0.5, -3.0, np.nan]])
    np.testing.assert_array_equal(filled(evidence), [[1.0, -3.0, 0.0], [0.5, -3.0, 0.0]])
