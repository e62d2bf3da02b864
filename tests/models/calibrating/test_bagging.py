"""How likely trials are to be the best, where this is known."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from models.calibrating.bagging import at_most, bagged_shares, filled, reconciled


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


@pytest.mark.parametrize("seed", range(5))
def test_no_direction_is_known_better_than_the_widest_allows(seed: int) -> None:
    """Even one in which both axes are uncertain, as of two lenses whose ratio alone is known."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    widest = root @ root.T + 0.1 * np.eye(2)
    sharp = rng.normal(size=(2, 1))
    information = 1e4 * sharp @ sharp.T + 1e-6 * np.eye(2)
    limited = at_most(information, widest)
    assert np.linalg.eigvalsh(np.linalg.inv(limited) - widest).min() > -1e-6
    assert np.linalg.eigvalsh(information - limited).min() > -1e-6
    along = sharp[:, 0] / np.linalg.norm(sharp)
    np.testing.assert_allclose(along @ limited @ along, 1 / (along @ widest @ along), rtol=1e-3)


def test_what_is_known_worse_than_the_widest_stays() -> None:
    information = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(at_most(information, 0.1 * np.eye(2)), information)


def test_what_is_far_off_the_usual_is_believed_less() -> None:
    """Along one axis the added variance has a closed form."""
    deviation, usual, off = 0.1, 0.3, 1.5
    information = np.eye(2) / deviation**2
    believed = reconciled(information, np.array([off, 0.0]), usual**2 * np.eye(2))
    more = off**2 / chi2.isf(0.025, 2) - deviation**2 - usual**2
    np.testing.assert_allclose(believed, np.eye(2) / (deviation**2 + more), rtol=1e-3)


@pytest.mark.parametrize("off", [[0.5, 0.5], [-0.7, 0.0], [0.0, 0.0]])
def test_what_is_near_the_usual_is_believed_as_before(off: list[float]) -> None:
    information = np.array([[90.0, 20.0], [20.0, 60.0]])
    believed = reconciled(information, np.array(off), 0.3**2 * np.eye(2))
    np.testing.assert_allclose(believed, information)
