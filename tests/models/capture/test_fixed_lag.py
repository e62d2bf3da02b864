"""Smoothing while frames come, against smoothing them all when they are there."""

from functools import partial

import numpy as np
import pytest

from models.capture.denoising import learn_denoiser
from models.capture.fixed_lag import FixedLag
from models.capture.motion import LEAST_CLIP, MotionModel, learn_motion
from models.capture.noise_removal import NoiseRemoval, learn_noise_removal
from models.capture.observations import as_observations, join_frames, pixels_of
from models.numerics.kalman import advance, smooth
from models.settings.times import MAX_LAG
from tests.models.capture.test_motion import CLEAN, FRAMES, NOISE, NOISY, TIMES
from tests.models.rigs import Float64

VIEWS = [0, 1]
MOMENTS = np.arange(FRAMES)


@pytest.fixture(scope="module")
def removal() -> NoiseRemoval:
    found = learn_noise_removal(as_observations(NOISY), TIMES)
    assert found.motion is not None
    assert found.denoiser is not None
    return found


@pytest.fixture(scope="module")
def motion(removal: NoiseRemoval) -> MotionModel:
    assert removal.motion is not None
    return removal.motion


def followed(
    removal: NoiseRemoval, keypoints: Float64, times: Float64, lag: int, views: list[int] = VIEWS
) -> Float64:
    """Return the pixels of all frames, as they were returned one after the other."""
    smoother, given = FixedLag(removal, views, lag), []
    for n in range(len(keypoints)):
        answer = smoother.push(as_observations(keypoints[n : n + 1]), float(times[n]))
        assert (answer is None) == (n < lag)
        given += [] if answer is None else [answer]
    rest = smoother.flush()
    assert len(given) == max(len(keypoints) - lag, 0)
    return pixels_of(join_frames([*given, *([] if rest is None else [rest])]))[0]


def left(pixels: Float64, truth: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(pixels - truth))))


@pytest.mark.parametrize("kind", ["whole", "gaps", "uneven times", "a cut", "one view"])
def test_with_all_frames_before_it_the_answer_is_that_of_smoothing_them_together(
    motion: MotionModel, kind: str
) -> None:
    keypoints, times, views = NOISY[:MAX_LAG].copy(), TIMES[:MAX_LAG].copy(), VIEWS
    if kind == "gaps":
        keypoints[np.random.default_rng(5).random(keypoints.shape[:3]) < 0.1] = np.nan
        keypoints[20:24, 1] = np.nan
        keypoints[30] = np.nan
    elif kind == "uneven times":
        times = np.cumsum(np.random.default_rng(6).uniform(0.005, 0.05, MAX_LAG))
    elif kind == "a cut":
        keypoints[25:] += 700
    elif kind == "one view":
        keypoints, views = keypoints[:, [1]], [1]
    expected, smoothed = motion.smooth(as_observations(keypoints), times, views)
    assert smoothed.all()
    found = followed(NoiseRemoval(None, motion), keypoints, times, MAX_LAG, views)
    np.testing.assert_allclose(found, pixels_of(expected)[0], atol=1e-3)


def test_without_a_lag_it_is_the_filter(motion: MotionModel) -> None:
    """Whose estimate at the last of some frames is that of smoothing these."""
    found = followed(NoiseRemoval(None, motion), NOISY, TIMES, 0)
    for last in (40, 120, FRAMES - 1):
        seen = as_observations(NOISY[: last + 1])
        expected = pixels_of(motion.smooth(seen, TIMES[: last + 1], VIEWS)[0])[0]
        np.testing.assert_allclose(found[last], expected[last], atol=0.02)


def test_a_state_goes_on_where_it_was_left() -> None:
    """Kalman: numbers smoothed from a state are the end of those smoothed from the beginning."""
    rng = np.random.default_rng(0)
    numbers, rates = rng.normal(size=(3, 60)).cumsum(1), np.array([0.01, 0.3, 4.0])
    steps, seen = rng.uniform(0.5, 2, 60), rng.random(60) < 0.8
    steps[0] = 0
    whole = smooth(numbers, steps, seen, rates, 1.0)
    state = np.zeros((3, 5))
    for n in range(40):
        state = advance(state, numbers[:, n], steps[n], bool(seen[n]), rates, 1.0)
    end = smooth(numbers[:, 40:], steps[40:], seen[40:], rates, 1.0, state)
    np.testing.assert_allclose(end.values, whole.values[:, 40:], rtol=1e-9)
    np.testing.assert_allclose(end.variances, whole.variances[:, 40:], rtol=1e-6)


def test_the_more_frames_follow_the_less_noise_is_left(removal: NoiseRemoval) -> None:
    assert removal.denoiser is not None
    alone = pixels_of(removal.denoiser.denoise(as_observations(NOISY), VIEWS))[0]
    remaining = [left(followed(removal, NOISY, TIMES, lag), CLEAN) for lag in (0, 2, 5, 20)]
    assert remaining[0] < left(alone, CLEAN)
    assert np.all(np.diff(remaining) < 0.01 * NOISE)
    assert remaining[-1] < 0.25 * NOISE


def test_frames_unlike_those_of_the_fit_keep_what_smoothing_makes_of_them() -> None:
    """The poses of a fit are no reason to move frames that are not among them."""
    rng = np.random.default_rng(11)
    directions = rng.normal(0, 30, (6, *CLEAN.shape[1:]))
    waves = np.sin(TIMES[:, None] * rng.uniform(1, 6, 6)) * (MOMENTS > 130)[:, None]
    truth = CLEAN + np.einsum(
        "nw,wkpc->nkpc", waves * np.minimum(MOMENTS - 130, 30)[:, None] / 30, directions
    )
    noisy = truth + rng.normal(0, NOISE, truth.shape)
    motion = learn_motion(as_observations(noisy), TIMES)
    denoiser = learn_denoiser(as_observations(noisy[:130]))
    assert denoiser is not None
    known, new = slice(130), slice(180, None)
    alone = pixels_of(denoiser.denoise(as_observations(noisy), VIEWS))[0]
    assert left(alone[new], truth[new]) > 1.5 * left(alone[known], truth[known])
    for lag in (0, 5):
        by_time = followed(NoiseRemoval(None, motion), noisy, TIMES, lag)
        by_both = followed(NoiseRemoval(denoiser, motion), noisy, TIMES, lag)
        assert left(by_both[new], truth[new]) < 1.1 * left(by_time[new], truth[new])


def test_a_jump_and_a_pause_begin_anew(motion: MotionModel) -> None:
    film_of_two = np.concatenate((CLEAN[:100], CLEAN[150:250] + 700))
    noisy = film_of_two + np.random.default_rng(6).normal(0, NOISE, film_of_two.shape)
    late = np.where(MOMENTS[:200] < 100, 0, 60) + TIMES[:200]
    for times in (TIMES[:200], late):
        for lag in (0, 5):
            found = followed(NoiseRemoval(None, motion), noisy, times, lag)
            assert np.abs(found - film_of_two)[98:102].mean() < NOISE
            after = slice(100 + LEAST_CLIP, None)
            assert left(found[after], film_of_two[after]) < 0.5 * NOISE


def test_what_moves_in_a_new_way_is_not_smoothed_away(motion: MotionModel) -> None:
    new = CLEAN.copy()
    new[100:150, :, 3, 0] += 60 * np.sin(np.arange(50) / 3)[:, None]
    noisy = new + np.random.default_rng(9).normal(0, NOISE, new.shape)
    found = followed(NoiseRemoval(None, motion), noisy, TIMES, 5)
    np.testing.assert_allclose(found[110:145], noisy[110:145], atol=1e-3)
    assert left(found[20:90], new[20:90]) < 0.3 * NOISE
    assert left(found[200:], new[200:]) < 0.3 * NOISE


def test_a_keypoint_that_appears_late_disturbs_nothing(removal: NoiseRemoval) -> None:
    keypoints = NOISY.copy()
    keypoints[:60, 0, 2] = np.nan
    for lag in (0, 5):
        found = followed(removal, keypoints, TIMES, lag)
        seen = np.isfinite(keypoints).all(-1)
        assert left(found[seen], CLEAN[seen]) < 0.5 * NOISE
        at_first = np.abs(found - CLEAN)[58:64]
        assert at_first[np.isfinite(at_first)].mean() < NOISE


def test_after_a_flush_another_film_begins(removal: NoiseRemoval) -> None:
    smoother = FixedLag(removal, VIEWS, 3)
    parts = []
    for first in (100, 0):  # the second film is of earlier times
        frames = slice(first, first + 40)
        given = [
            smoother.push(as_observations(NOISY[n : n + 1]), float(TIMES[n]))
            for n in range(frames.start, frames.stop)
        ]
        given.append(smoother.flush())
        parts.append(pixels_of(join_frames([t for t in given if t is not None]))[0])
        expected = followed(removal, NOISY[frames], TIMES[frames], 3)
        np.testing.assert_array_equal(parts[-1], expected)
    assert smoother.flush() is None


@pytest.mark.parametrize("times", [[0.0, 0.0], [0.0, -1.0], [0.0, np.nan]])
def test_times_that_do_not_rise_are_refused(removal: NoiseRemoval, times: list[float]) -> None:
    smoother = FixedLag(removal, VIEWS, 0)
    smoother.push(as_observations(NOISY[:1]), times[0])
    with pytest.raises(ValueError, match="times must increase"):
        smoother.push(as_observations(NOISY[1:2]), times[1])


def test_what_cannot_be_smoothed_is_refused(removal: NoiseRemoval) -> None:
    with pytest.raises(ValueError, match="fit a dataset with fps or times"):
        FixedLag(NoiseRemoval(removal.denoiser, None), VIEWS, 5)
    for lag in (-1, MAX_LAG + 1):
        with pytest.raises(ValueError, match="lag must be 0 to 50"):
            FixedLag(removal, VIEWS, lag)
    push = partial(FixedLag(removal, VIEWS, 0).push, time=0.0)
    for wrong in (NOISY[:2], NOISY[:1, :1]):
        with pytest.raises(ValueError, match="expected one frame of 2 views"):
            push(as_observations(wrong))
