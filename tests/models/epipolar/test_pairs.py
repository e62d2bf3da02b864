"""Relative poses and focal lengths of two views, against cameras that are known exactly."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from models.epipolar.pairs import (
    LEAST_CORRESPONDENCES,
    Beliefs,
    RelativePoses,
    essential_of,
    relate,
)

Float64 = NDArray[np.float64]

TURN = Rotation.from_euler("yxz", [70.0, -15.0, 4.0], degrees=True)
SHIFT = np.array([-3.5, 0.4, 2.2])  # of a subject four units before the first camera
FOCALS = np.array([0.9, 1.6])  # sides
FREE = np.array([0.5, 0.5])
GIVEN = np.zeros(2)
FREEDOM = 3.0  # of Student's t


def seen(count: int = 300, noise: float = 0.0, seed: int = 0) -> tuple[Float64, Float64]:
    """Return the images (M, 2), in sides, of points about the subject's place."""
    rng = np.random.default_rng(seed)
    points = np.array([0.0, 0.0, 4.0]) + rng.uniform(-1, 1, (count, 3))
    other = TURN.apply(points) + SHIFT
    x = FOCALS[0] * points[:, :2] / points[:, 2:]
    y = FOCALS[1] * other[:, :2] / other[:, 2:]
    return x + noise * rng.normal(size=x.shape), y + noise * rng.normal(size=y.shape)


def related(
    x: Float64, y: Float64, expected: Float64 = FOCALS, sds: Float64 = GIVEN, seed: int = 0
) -> RelativePoses:
    found = relate(x, y, expected, sds, np.random.default_rng(seed))
    assert found is not None
    return found


@cache
def exact() -> RelativePoses:
    """Find the poses of exact images through given lenses."""
    return related(*seen())


def degrees_off(found: RelativePoses) -> tuple[float, float]:
    """Return how far the best rotation and the direction to the other camera are off."""
    turn = (TURN.inv() * Rotation.from_matrix(found.rotations[0])).magnitude()
    cosine = found.translations[0] @ SHIFT / np.linalg.norm(SHIFT)
    return float(np.degrees(turn)), float(np.degrees(np.arccos(min(cosine, 1.0))))


def homogeneous(flat: Float64) -> Float64:
    return np.column_stack((flat, np.ones(len(flat))))


def test_given_lenses_give_the_exact_pose() -> None:
    found = exact()
    assert max(degrees_off(found)) < 1e-4
    np.testing.assert_array_equal(found.focals[0], FOCALS)
    assert found.noise < 1e-7
    assert (np.diff(found.costs) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.translations, axis=1), 1)
    np.testing.assert_allclose(np.linalg.det(found.rotations), 1)


def test_the_fundamental_matrix_ties_exact_images() -> None:
    x, y = seen()
    matrix = exact().fundamental
    errors = (homogeneous(y) * (homogeneous(x) @ matrix.T)).sum(1)
    assert np.abs(errors).max() < 1e-6 * np.linalg.norm(matrix)
    assert abs(np.linalg.det(matrix)) < 1e-9 * np.linalg.norm(matrix) ** 3


@pytest.mark.parametrize("expected", [FOCALS * 1.25, FOCALS * [0.75, 1.3]])
def test_exact_images_correct_the_lenses_that_were_expected(expected: Float64) -> None:
    found = related(*seen(), expected, FREE)
    np.testing.assert_allclose(found.focals[0], FOCALS, rtol=0.02)
    assert max(degrees_off(found)) < 0.5


def test_one_given_lens_stays_and_the_other_is_found() -> None:
    found = related(*seen(), FOCALS * [1.0, 1.4], np.array([0.0, 0.5]))
    assert found.focals[0, 0] == FOCALS[0]
    assert found.focals[0, 1] == pytest.approx(FOCALS[1], rel=2e-3)


def test_swapped_views_give_the_inverse_pose() -> None:
    x, y = seen()
    found = related(y, x, FOCALS[::-1])
    back = TURN.inv()
    np.testing.assert_allclose(found.rotations[0], back.as_matrix(), atol=1e-5)
    expected = -back.apply(SHIFT) / np.linalg.norm(SHIFT)
    np.testing.assert_allclose(found.translations[0], expected, atol=1e-5)


def test_wrong_correspondences_do_no_harm() -> None:
    x, y = seen(noise=5e-4)
    wrong = np.random.default_rng(1).random(len(x)) < 0.25
    y[wrong] = np.random.default_rng(2).uniform(-0.5, 0.5, (int(wrong.sum()), 2))
    assert max(degrees_off(related(x, y))) < 1


def test_the_noise_is_that_of_a_coordinate() -> None:
    """A Sampson distance is one number, of the same variance as each coordinate's noise."""
    assert related(*seen(900, noise=2e-3)).noise == pytest.approx(2e-3, rel=0.1)


def test_distinct_solutions_are_far_apart() -> None:
    found = related(*seen(150, noise=4e-3), FOCALS, FREE)
    turns = Rotation.from_matrix(found.rotations)
    for one in range(len(turns)):
        for other in range(one):
            assert (turns[one].inv() * turns[other]).magnitude() > 0.2


def test_too_few_correspondences_give_no_pose() -> None:
    x, y = seen(LEAST_CORRESPONDENCES)
    assert max(degrees_off(related(x, y))) < 0.1
    rng = np.random.default_rng(0)
    assert relate(x[1:], y[1:], FOCALS, FREE, rng) is None


def misfit(
    numbers: Float64, x: Float64, y: Float64, noise: float, expected: Float64, sds: Float64
) -> float:
    """Return the cost of (rotation vector, translation, log focal lengths), by another route.

    Sampson's distance is written out with lines of the fundamental matrix.
    """
    turn = Rotation.from_rotvec(numbers[:3]).as_matrix()
    a, b, c = numbers[3:6] / np.linalg.norm(numbers[3:6])
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    f, g = np.exp(numbers[6:])
    matrix = np.diag([1 / g, 1 / g, 1]) @ cross @ turn @ np.diag([1 / f, 1 / f, 1])
    lines, back = homogeneous(x) @ matrix.T, homogeneous(y) @ matrix
    errors = (homogeneous(y) * lines).sum(1)
    squared = errors**2 / (np.square(lines[:, :2]).sum(1) + np.square(back[:, :2]).sum(1))
    robust = (FREEDOM + 1) * np.log1p(squared / noise**2 / FREEDOM).mean()
    prior = np.square((numbers[6:] - np.log(expected)) / sds).sum() / len(x)
    return float(robust + prior)


def test_poses_and_lenses_are_those_of_least_cost() -> None:
    """The prior is strong here, and wrong by three standard deviations: both sides must count."""
    x, y = seen(150, noise=3e-3)
    expected, sds = FOCALS * np.exp([0.15, -0.15]), np.array([0.05, 0.05])
    found = related(x, y, expected, sds)
    turn = Rotation.from_matrix(found.rotations[0]).as_rotvec()
    numbers = np.concatenate((turn, found.translations[0], np.log(found.focals[0])))
    data = (x, y, found.noise, expected, sds)
    assert found.costs[0] == pytest.approx(misfit(numbers, *data), rel=1e-9)
    best = minimize(misfit, numbers, args=data, method="BFGS")
    assert found.costs[0] - best.fun < 1e-3
    np.testing.assert_allclose(best.x[6:], numbers[6:], atol=0.2 * sds[0])


def test_an_essential_matrix_is_the_cross_product_after_the_turn() -> None:
    rng = np.random.default_rng(0)
    turns, shifts = Rotation.random(5, random_state=0).as_matrix(), rng.normal(size=(5, 3))
    vectors = rng.normal(size=(5, 3))
    mapped = (essential_of(turns, shifts) @ vectors[..., None])[..., 0]
    expected = [np.cross(t, r @ v) for r, t, v in zip(turns, shifts, vectors, strict=True)]
    np.testing.assert_allclose(mapped, expected, atol=1e-12)


def beliefs(views: int = 3) -> Beliefs:
    """Return a prior of random covariances; the last view's focal length is given."""
    rng = np.random.default_rng(views)

    def covariance() -> Float64:
        root = rng.normal(size=(views, views))
        return np.asarray(root @ root.T + 0.1 * np.eye(views))

    focal = covariance()
    focal[-1], focal[:, -1] = 0, 0
    radial = np.stack((covariance(), np.zeros((views, views))))
    return Beliefs(rng.uniform(1, 2, views), focal, covariance(), radial, alike=False)


def test_precisions_are_inverse_covariances_of_what_is_not_given() -> None:
    prior = beliefs()
    precisions = prior.precisions
    assert precisions.shape == (5, 3, 3)
    focal = np.linalg.inv(prior.focal_covariance[:2, :2])
    np.testing.assert_allclose(precisions[0, :2, :2], focal)
    assert not precisions[0, 2].any()
    assert not precisions[0, :, 2].any()
    for centre in precisions[1:3]:
        np.testing.assert_allclose(centre @ prior.centre_covariance, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(precisions[3] @ prior.radial_covariance[0], np.eye(3), atol=1e-9)
    assert not precisions[4].any()


def test_the_prior_of_some_views_is_their_marginal() -> None:
    prior = beliefs(4)
    some = prior.of([2, 0])
    np.testing.assert_array_equal(some.focals, prior.focals[[2, 0]])
    assert some.focal_covariance[0, 1] == prior.focal_covariance[2, 0]
    assert some.centre_covariance[1, 1] == prior.centre_covariance[0, 0]
    assert some.radial_covariance.shape == (2, 2, 2)
    assert some.radial_covariance[0, 1, 0] == prior.radial_covariance[0, 0, 2]
    assert not some.alike
    np.testing.assert_allclose(some.focal_sds**2, prior.focal_covariance.diagonal()[[2, 0]])
