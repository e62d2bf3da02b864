"""The evidence of shapes, for subjects that are what it assumes and for some that are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.lens_profile import FROM_LOGS, Kind, kinds_of, pair_of, walk_lenses
from models.calibrating.problem import problem_of
from models.calibrating.shape_evidence import (
    Located,
    alike_in_all,
    blocks_of,
    locate,
    shape_evidence,
)
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, around
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
FRAMES, KEYPOINTS = 80, 14
TRUTH = np.log(FOCAL / max(IMAGE_SIZE))


def linear_shapes(rng: np.random.Generator, frames: int = FRAMES) -> Float64:
    """Return structures (N, P, 3) of a linear shape model that changes smoothly in time."""
    mean, basis = rng.normal(size=(KEYPOINTS, 3)), 0.25 * rng.normal(size=(3, KEYPOINTS, 3))
    steps = np.cumsum(rng.normal(size=(frames, 3)), 0)
    steps = (steps - steps.mean(0)) / steps.std(0)
    return np.asarray(0.35 * (mean + np.einsum("nq,qpi->npi", steps, basis)))


def turned(points: Float64, rng: np.random.Generator) -> Float64:
    """Return the structures as they turn about the vertical and wander."""
    angles = np.linspace(0, 2.5 * np.pi, len(points))
    cos, sin, one = np.cos(angles), np.sin(angles), np.ones(len(points))
    zero = 0 * one
    turns = np.array([[cos, zero, sin], [zero, one, zero], [-sin, zero, cos]]).transpose(2, 0, 1)
    return np.asarray(points @ turns.mT + 0.4 * rng.normal(size=(1, 1, 3)))


def evidence_along(
    points: Float64, kind: Kind | None, noise: float, seed: int
) -> tuple[Float64, Float64]:
    """Return common log focal lengths, and the evidence of noisy keypoints there.

    Cameras are adjusted to keypoints without noise, so that shapes alone err. Without a `kind` of
    lenses, they are alike and of any focal length.
    """
    rotations, translations = around([0.0, 70.0])
    pixels = Lens().project(points[:, None] @ rotations.mT + translations[:, None])
    config = FitConfig(cameras_alike=True)
    problem = problem_of(pixels, np.ones(pixels.shape[:3]), [IMAGE_SIZE] * 2, config)
    found = finished(geometry_of(problem, declared=True)).rig
    assert found is not None
    pair = pair_of(problem, found)
    kinds = kinds_of(problem) if kind is None else [kind]
    (walk,) = finished(walk_lenses(pair, kinds)).walks
    errors = np.random.default_rng(seed).normal(size=pair.images.shape)
    noisy = pair.images + noise / problem.side * errors
    trials = [
        locate(place.cameras.rig, noisy, pair.weights, noise / problem.side)
        for place in walk.places
    ]
    evidence = [float(shape_evidence(trial).sum()) for trial in alike_in_all(trials)]
    return np.array([place.at[0] for place in walk.places]), np.array(evidence)


@pytest.mark.parametrize("seed", thorough_after(1, range(3)))
def test_of_a_linear_shape_model_it_has_one_peak_without_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    commons, evidence = evidence_along(turned(linear_shapes(rng), rng), None, 2.0, seed)
    top = int(evidence.argmax())
    assert (np.diff(evidence)[:top] > 0).all()
    assert (np.diff(evidence)[top:] < 0).all()
    assert abs(commons[top] - TRUTH) < 0.15


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_of_a_linear_shape_model_it_peaks_at_the_truth(seed: int) -> None:
    """Within three of its own standard deviations, as curvature gives them."""
    rng = np.random.default_rng(seed)
    kind = Kind(1.0, np.array([TRUTH + 0.02, 0.0]), np.diag([0.02**2, 0.01**2]))
    commons, evidence = evidence_along(turned(linear_shapes(rng), rng), kind, 2.0, seed)
    bend, slope, _ = np.polyfit(commons - TRUTH, evidence, 2)
    assert bend < 0
    assert abs(slope / (2 * bend)) < 3 / np.sqrt(-2 * bend)


def located(points: Float64, stretch: Float64, noise: float) -> Located:
    """Return structures in a room that is stretched (3, 3), with their information."""
    unit = np.linalg.inv(stretch)
    information = np.broadcast_to(unit.T @ unit / noise**2, (*points.shape, 3))
    return Located(points @ stretch.T, information.copy())


def test_a_subject_that_never_turns_has_no_evidence_of_a_stretched_room() -> None:
    """Wrong lenses of distant cameras stretch the room; only turning shows that."""
    rng = np.random.default_rng(0)
    still = linear_shapes(rng) + 0.02 * rng.normal(size=(FRAMES, KEYPOINTS, 3))
    turning = turned(still, rng)
    values_of = {}
    for name, points in (("still", still), ("turning", turning)):
        values = [
            float(shape_evidence(located(points, np.diag([1.0, 1.0, depth]), 0.01)).sum())
            for depth in (0.7, 1.0, 1.4)
        ]
        values_of[name] = max(values[1] - values[0], values[1] - values[2]), values
    assert values_of["turning"][1][1] == max(values_of["turning"][1])
    assert values_of["turning"][0] > 500
    assert np.ptp(values_of["still"][1]) < 0.1 * values_of["turning"][0]


def test_trials_are_judged_on_the_points_that_all_of_them_know() -> None:
    rng = np.random.default_rng(0)
    whole = located(linear_shapes(rng, 12), np.eye(3), 0.01)
    partly = whole._replace(information=whole.information.copy())
    partly.information[0, 5:] = 0
    partly.information[1, 2:] = 0  # too little is left of this frame
    first, second = alike_in_all([whole, partly])
    np.testing.assert_array_equal(first.known, second.known)
    assert first.known[0].sum() == 5
    assert not first.known[1].any()


def test_frames_that_show_nothing_have_no_evidence() -> None:
    rng = np.random.default_rng(0)
    points = located(turned(linear_shapes(rng), rng), np.eye(3), 0.01)
    points.information[7] = 0
    evidence = shape_evidence(points)
    assert np.flatnonzero(np.isnan(evidence)).tolist() == [7]


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        shape_evidence(Located(np.zeros((3, 8, 3)), np.zeros((3, 8, 3, 3))))


@pytest.mark.parametrize("frames", [4, 37, 500])
def test_blocks_are_of_neighbours_and_of_equal_length(frames: int) -> None:
    blocks = blocks_of(frames)
    assert (np.diff(blocks) >= 0).all()
    counts = np.bincount(blocks)
    assert len(counts) >= 4
    assert np.ptp(counts) <= 1


def test_common_and_ratio_are_those_of_the_logs() -> None:
    np.testing.assert_allclose(FROM_LOGS @ np.log([2.0, 8.0]), np.log([4.0, 0.25]))
