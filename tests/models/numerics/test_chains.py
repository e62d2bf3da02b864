"""Chains, against the dense posterior of all their points together."""

import numpy as np

from models.numerics.chains import smooth_chain

POINTS, SIZE = 9, 3


def test_a_chain_is_the_posterior_of_its_points() -> None:
    rng = np.random.default_rng(1)
    counts = np.array([2.0, 0.0, 0.5, 3.0, 0.0, 0.0, 1.0, 4.0, 0.0])
    sums = counts[:, None] * rng.normal(size=(POINTS, SIZE))
    rates, scales = rng.uniform(0.1, 2, SIZE), rng.uniform(0.3, 3, POINTS - 2)
    chain = smooth_chain(sums, counts, rates, scales)
    second = np.diff(np.eye(POINTS), 2, axis=0)  # (M - 2, M)
    for q, rate in enumerate(rates):
        precision = np.diag(counts) + second.T @ np.diag(1 / (rate * scales)) @ second
        covariance = np.linalg.inv(precision)
        np.testing.assert_allclose(chain.points[:, q], covariance @ sums[:, q], rtol=1e-9)
        np.testing.assert_allclose(chain.variances[:, q], np.diag(covariance), rtol=1e-9)
        doubts = np.diag(second @ covariance @ second.T)
        np.testing.assert_allclose(chain.doubts[:, q], doubts, rtol=1e-9)


def test_three_points_that_are_measured_twice_lie_on_a_line() -> None:
    measured = np.array([[1.0], [0.0], [5.0]])
    chain = smooth_chain(measured, np.array([1.0, 0.0, 1.0]), np.array([0.01]), np.ones(1))
    np.testing.assert_allclose(chain.points, [[1.0], [3.0], [5.0]], rtol=1e-9)
