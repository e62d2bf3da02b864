"""Kinds of lenses, from the keypoints' likelihood of focal lengths."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from models.calibrating.lens_groups import (
    covariance_over_kinds,
    find_lens_groups,
    group_covariance,
)
from models.epipolar.rig_certainty import FocalLikelihood

TOGETHER, ALONE = 0.3, 0.01
EXPECTED = np.log(1.2)


def groups_of(focals: list[float], sd: float) -> list[int]:
    """Find the kinds of lenses whose focal lengths were measured with this relative error."""
    views = len(focals)
    information = np.eye(views) / sd**2
    message = FocalLikelihood(information, information @ np.log(focals))
    found = find_lens_groups(message, np.full(views, EXPECTED), TOGETHER, ALONE)
    return [int(kind) for kind in found]


@pytest.mark.parametrize(
    ("focals", "sd", "kinds"),
    [
        ([1.1, 1.105, 1.098, 1.1], 0.005, [0, 0, 0, 0]),
        ([0.6, 1.1, 1.9], 0.005, [0, 1, 2]),
        ([0.8, 1.5, 0.805, 1.49, 1.5], 0.005, [0, 1, 0, 1, 1]),
        ([0.8, 1.2, 1.0], 0.3, [0, 0, 0]),  # too uncertain
        ([1.3], 0.01, [0]),
    ],
)
def test_kinds_are_those_that_the_measurements_show(
    focals: list[float], sd: float, kinds: list[int]
) -> None:
    assert groups_of(focals, sd) == kinds


def test_the_kinds_found_are_the_likeliest_of_all() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        sd = float(np.exp(rng.uniform(np.log(0.003), np.log(0.05))))
        truth = rng.integers(3, size=4)
        logs = EXPECTED + 0.3 * rng.standard_normal(3)[truth] + sd * rng.standard_normal(4)

        def likelihood(
            groups: NDArray[np.int64], logs: NDArray[np.float64] = logs, sd: float = sd
        ) -> float:
            covariance = group_covariance(groups, TOGETHER, ALONE) + sd**2 * np.eye(4)
            return float(multivariate_normal.logpdf(logs, np.full(4, EXPECTED), covariance))

        found = np.array(groups_of(np.exp(logs).tolist(), sd))
        every = [np.array([0, a, b, c]) for a in range(2) for b in range(3) for c in range(4)]
        most = max(likelihood(groups) for groups in every)
        one = likelihood(np.zeros(4, np.int64))
        # One kind is believed unless others are clearly likelier.
        assert likelihood(found) > most - 1e-9 or (found.max() == 0 and most < one + 5 + 1e-9)


def test_deviations_span_the_answers_with_one_kind_and_with_several() -> None:
    """Against sums over a grid of the two focal lengths, with either prior as likely."""
    information = np.array([[40.0, -15.0], [-15.0, 25.0]])
    likelihood = FocalLikelihood(information, information @ np.array([0.1, 0.7]))
    expected, about = np.full(2, EXPECTED), np.array([0.3, 0.4])
    priors = [group_covariance(np.array(kinds), TOGETHER, 0.1) for kinds in ([0, 0], [0, 1])]
    axis = np.linspace(-2.5, 3, 600)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    logs = -np.einsum("na,ab,nb->n", grid, information, grid) / 2 + grid @ likelihood.vector
    density = np.exp(logs) * sum(multivariate_normal(expected, each).pdf(grid) for each in priors)
    density /= density.sum()
    found = covariance_over_kinds(likelihood, expected, priors, about)
    true = (grid - about).T @ (density[:, None] * (grid - about))
    np.testing.assert_allclose(found, true, rtol=1e-4)
