"""Fundamental matrices against cameras that are known exactly."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.epipolar.fundamental import common_offsets, fit_fundamental, sampson_distances
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]


def correspondences(rng: np.random.Generator, count: int) -> tuple[Float64, Float64, Float64]:
    """Points in two known cameras, and their true fundamental matrix."""
    points = rng.normal((0, 0, 6), 1, (count, 3))
    rotation = rotations_from_vectors(np.array([0.1, 0.9, -0.2]))
    translation = np.array([-5.0, 0.3, 3.0])
    k1, k2 = np.diag([900.0, 900, 1]), np.diag([1300.0, 1300, 1])
    k1[:2, 2], k2[:2, 2] = (640, 360), (500, 500)
    x = points @ k1.T
    y = (points @ rotation.T + translation) @ k2.T
    a, b, c = translation
    skew = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    true = np.linalg.inv(k2).T @ skew @ rotation @ np.linalg.inv(k1)
    return x[:, :2] / x[:, 2:], y[:, :2] / y[:, 2:], true / np.linalg.norm(true)


def test_it_is_exact_without_noise() -> None:
    x, y, true = correspondences(np.random.default_rng(0), 100)
    found = fit_fundamental(x, y)
    assert min(np.abs(found.matrix - true).max(), np.abs(found.matrix + true).max()) < 1e-8


def test_outliers_and_noise_do_not_bend_it() -> None:
    rng = np.random.default_rng(1)
    x, y, true = correspondences(rng, 2000)
    noisy_x, noisy_y = x + rng.normal(size=x.shape), y + rng.normal(size=y.shape)
    noisy_y[:400] = rng.uniform(0, 1000, (400, 2))
    found = fit_fundamental(noisy_x, noisy_y)
    assert np.abs(sampson_distances(found.matrix, x, y)).max() < 1.0
    assert 0.8 < found.scale < 1.6
    clean = sampson_distances(true, noisy_x[400:], noisy_y[400:])
    assert clean.std() == pytest.approx(1.0, rel=0.05)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ValueError, match="needs 8"):
        fit_fundamental(np.zeros((7, 2)), np.zeros((7, 2)))


def test_two_wrong_correspondences_in_five_do_not_lead_it_astray() -> None:
    rng = np.random.default_rng(2)
    x, y, _ = correspondences(rng, 1500)
    noisy_x, noisy_y = x + 2 * rng.normal(size=x.shape), y + 2 * rng.normal(size=y.shape)
    noisy_y[:600] = rng.uniform(y.min(0), y.max(0), (600, 2))
    found = fit_fundamental(noisy_x, noisy_y)
    assert np.median(np.abs(sampson_distances(found.matrix, x, y))) < 1.0
    assert found.scale < 6


def test_offsets_that_frames_have_in_common_are_measured() -> None:
    """The expected ratio is 1 + n s^2 for offsets of n keypoints of deviation s, in common."""
    rng, frames = np.random.default_rng(3), np.repeat(np.arange(4000), 9)
    noise = 0.3 * rng.standard_normal(len(frames))
    assert common_offsets(noise, frames) == pytest.approx(1.0, abs=0.1)
    shared = 0.6 * rng.standard_normal(4000)
    assert common_offsets(noise + shared[frames], frames) == pytest.approx(1 + 9 * 4, rel=0.1)
    assert np.isnan(common_offsets(noise[:9], np.arange(9)))
