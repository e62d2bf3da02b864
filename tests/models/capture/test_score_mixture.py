"""The mixture over scores, against densities and conditional means that SciPy computes."""

import numpy as np
import pytest
from scipy.optimize import root
from scipy.stats import multivariate_normal

from models.capture.score_mixture import (
    ScoreMixture,
    learn_mixture,
    posterior_means_into,
    standard_normal,
)
from tests.models.rigs import Float64

COMPONENTS, SIZE, COORDINATES, NOISE = 3, 2, 6, 0.7


@pytest.fixture(scope="module")
def basis() -> Float64:
    return np.random.default_rng(1).normal(size=(COORDINATES, SIZE))


@pytest.fixture(scope="module")
def parts() -> tuple[Float64, Float64, Float64]:
    """Shares, centres and covariances."""
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(COMPONENTS, SIZE, SIZE))
    covariances = roots @ roots.mT + 0.1 * np.eye(SIZE)
    return np.array([0.2, 0.5, 0.3]), rng.normal(0, 2, (COMPONENTS, SIZE)), covariances


@pytest.fixture(scope="module")
def mixture(parts: tuple[Float64, Float64, Float64]) -> ScoreMixture:
    shares, centres, covariances = parts
    heights = np.log(shares) - np.linalg.slogdet(covariances).logabsdet / 2
    return ScoreMixture(heights, centres, np.asarray(np.linalg.inv(covariances), np.float64))


def test_expected_scores_are_those_of_bayes(
    mixture: ScoreMixture, parts: tuple[Float64, Float64, Float64], basis: Float64
) -> None:
    rng = np.random.default_rng(3)
    offsets = rng.normal(0, 2, (40, COORDINATES))
    observed = rng.random(offsets.shape) < 0.7
    observed[:2] = [[True] * COORDINATES, [False] * COORDINATES]
    observed[5] = observed[4]  # what was factorised for one frame serves the next
    found = np.empty((len(offsets), SIZE))
    posterior_means_into(mixture, basis / NOISE, offsets / NOISE, observed, 0.0, found)
    for offset, seen, mean in zip(offsets, observed, found, strict=True):
        own = basis[seen]
        densities, means = [], []
        for share, centre, covariance in zip(*parts, strict=True):
            spread = own @ covariance @ own.T + NOISE**2 * np.eye(seen.sum())
            away = offset[seen] - own @ centre
            density = multivariate_normal.pdf(away, cov=spread) if seen.any() else 1.0
            densities.append(share * density)
            means.append(centre + covariance @ own.T @ np.linalg.solve(spread, away))
        expected = np.average(means, axis=0, weights=densities)
        np.testing.assert_allclose(mean, expected, rtol=1e-9, atol=1e-12)


def test_expected_scores_under_heavy_tails_are_the_likeliest(basis: Float64) -> None:
    """Of one Gaussian under Student's t, against the root that SciPy finds."""
    degrees, rng = 4.0, np.random.default_rng(5)
    offsets = rng.normal(0, 2, (20, COORDINATES))
    offsets[:, :2] += 8  # of one keypoint
    shown = np.ones(offsets.shape, np.bool_)
    found = np.empty((len(offsets), SIZE))
    posterior_means_into(standard_normal(SIZE), basis, offsets, shown, 1 / degrees, found)

    def slope(scores: Float64, offset: Float64) -> Float64:
        residuals = offset - basis @ scores
        squared = np.square(residuals).reshape(-1, 2).sum(1).repeat(2)
        weights = np.minimum((degrees + 2) / (degrees + squared), 1)
        return np.asarray(scores - basis.T @ (weights * residuals), np.float64)

    gaussian = np.empty_like(found)
    posterior_means_into(standard_normal(SIZE), basis, offsets, shown, 0.0, gaussian)
    best = np.array(
        [root(slope, start, args=(o,)).x for start, o in zip(gaussian, offsets, strict=True)]
    )
    off = np.linalg.norm(found - best, axis=1)
    assert np.median(off / np.linalg.norm(gaussian - best, axis=1)) < 0.1


def test_a_mixture_is_learnt_from_noisy_scores(
    parts: tuple[Float64, Float64, Float64],
) -> None:
    """What was learnt expects clean scores nearly as surely as what the scores were drawn from."""
    shares, _, _ = parts
    rng = np.random.default_rng(4)
    centres = np.array([[-6.0, 0.0], [5.0, 5.0], [6.0, -5.0]])
    covariances = np.array([np.diag([0.05, 1.0]), np.diag([1.0, 0.05]), np.diag([0.3, 0.3])])
    drawn = rng.choice(COMPONENTS, size=3000, p=shares)
    clean = centres[drawn] + np.einsum(
        "nij,nj->ni", np.sqrt(covariances)[drawn], rng.normal(size=(3000, SIZE))
    )
    noisy = clean + rng.normal(0, NOISE, clean.shape)

    def left(mixture: ScoreMixture) -> float:
        found = np.empty_like(noisy)
        shown = np.ones(noisy.shape, np.bool_)
        basis = np.eye(SIZE) / NOISE
        posterior_means_into(mixture, basis, noisy / NOISE, shown, 0.0, found)
        return float(np.mean((found - clean) ** 2))

    heights = np.log(shares) - np.linalg.slogdet(covariances).logabsdet / 2
    best = left(ScoreMixture(heights, centres, np.linalg.inv(covariances)))
    learnt = left(learn_mixture(noisy, NOISE))
    assert learnt < 1.2 * best
    assert learnt < 0.8 * left(standard_normal(SIZE))


def test_scores_that_are_all_alike_are_learnt_too() -> None:
    mixture = learn_mixture(np.ones((50, SIZE)), NOISE)
    found = np.empty((1, SIZE))
    shown = np.ones((1, SIZE), np.bool_)
    offsets = np.full((1, SIZE), 1.5 / NOISE)
    posterior_means_into(mixture, np.eye(SIZE) / NOISE, offsets, shown, 0.0, found)
    np.testing.assert_allclose(found, 1, atol=0.05)
