"""Known structures sharpen noisy frames, against a figure that turns, and dense algebra."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle.problem import ShapePrior
from models.capture.metrics import pa_mpjpe
from models.lifting.fitted_prior import FittedPrior
from models.lifting.observing import join_observed
from models.lifting.sharpening import most_likely
from models.numerics.compiled import compiled
from models.settings.config import FitConfig
from models.training.trainer import fit
from tests.models.lifting.comparison import without
from tests.models.rigs import Float64, RigCapture, make_rig_capture
from tests.sharing import fitted_once

AZIMUTHS = [0.0, 70.0, 140.0]
QUICK = FitConfig(steps=200, dictionary_sizes=(16, 8), batch_size=16, cameras="static")
FRAMES, POSES, NOISE = 160, 4, 15.0


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    """Return a figure that has few poses, each of which it takes facing all ways."""
    poses = make_rig_capture(AZIMUTHS, frames=FRAMES, noise=0, hidden=0, seed=3)
    random = np.random.default_rng(4)
    angles = random.uniform(-np.pi, np.pi, FRAMES)
    turns = np.zeros((FRAMES, 3, 3))
    turns[:, 0, 0] = turns[:, 2, 2] = np.cos(angles)
    turns[:, 0, 2], turns[:, 2, 0], turns[:, 1, 1] = np.sin(angles), -np.sin(angles), 1
    chosen = random.integers(POSES, size=FRAMES)
    figure = poses.points3d[chosen] @ turns.mT
    camera = figure[:, None] @ poses.rotations.mT + poses.translations[:, :, None]
    pixels = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(poses.lenses)], axis=1)
    noisy = pixels + NOISE * random.standard_normal(pixels.shape)
    return RigCapture(noisy, figure, poses.rotations, poses.translations, poses.lenses)


@pytest.fixture(scope="module")
def prior(capture: RigCapture) -> FittedPrior:
    return fitted_once("sharpening", lambda: fit(capture.keypoints, QUICK))


@pytest.fixture(scope="module")
def plain(prior: FittedPrior) -> FittedPrior:
    """Return the same prior as files of versions have it that knew no structures."""
    return without(prior, "structures")


def error_of(prior: FittedPrior, keypoints: Float64, truth: Float64) -> float:
    return float(pa_mpjpe(prior.lift(keypoints).points3d, truth, reflection="never").mean)


def test_poses_that_come_back_turned_improve_each_other(
    capture: RigCapture, prior: FittedPrior, plain: FittedPrior
) -> None:
    assert prior.denoises
    ours, theirs = (error_of(p, capture.keypoints, capture.points3d) for p in (prior, plain))
    assert ours < 0.85 * theirs


def test_frames_unlike_the_fit_are_not_harmed(
    capture: RigCapture, prior: FittedPrior, plain: FittedPrior
) -> None:
    other = make_rig_capture(AZIMUTHS, frames=40, noise=NOISE, hidden=0, seed=9)
    ours, theirs = (error_of(p, other.keypoints, other.points3d) for p in (prior, plain))
    assert ours < 1.1 * theirs


def test_frames_seen_together_are_lifted_as_each_alone(
    capture: RigCapture, prior: FittedPrior
) -> None:
    some, others = capture.keypoints[:3], capture.keypoints[3:5]
    untouched = prior.observe(others)
    untouched = untouched._replace(detected=untouched.detected[:0])
    together = prior.lift_observed(join_observed([prior.observe(some), untouched]))
    apart = [prior.lift(some), prior.lift_observed(untouched)]
    expected = np.concatenate([lift.points3d for lift in apart])
    np.testing.assert_allclose(together.points3d, expected, atol=1e-6)


@compiled
def solve(
    prior: ShapePrior, origin: Float64, information: Float64, pull: Float64, points: Float64
) -> float:
    return most_likely(prior, origin, information, pull, points)


def test_the_most_likely_points_are_those_of_dense_algebra() -> None:
    random = np.random.default_rng(5)
    count, size, spread = 6, 4, 0.3
    mean, origin, pull = random.standard_normal((3, count, 3))
    basis = random.standard_normal((3 * count, size))
    factors = random.standard_normal((count, 3, 2))
    factors[0] = 0  # one point is not observed
    information = factors @ factors.mT
    inner = basis.T @ basis + spread**2 * np.eye(size)
    shape = ShapePrior(
        mean, basis, inner, np.linalg.cholesky(inner).astype(np.float64), spread, 1.0, False
    )
    points = np.empty((count, 3))
    misfit = solve(shape, origin, information, pull, points)

    covariance = basis @ basis.T + spread**2 * np.eye(3 * count)
    given = np.zeros((3 * count, 3 * count))
    for p in range(count):
        given[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] = information[p]
    fields = given @ (origin - mean).ravel() + pull.ravel()
    offset: NDArray[np.float64] = np.linalg.solve(np.linalg.inv(covariance) + given, fields)
    np.testing.assert_allclose(points.ravel(), mean.ravel() + offset, atol=1e-9)
    assert misfit == pytest.approx(offset @ np.linalg.solve(covariance, offset))
