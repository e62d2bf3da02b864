"""Offsets in time against films whose moments are known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.epipolar.synchronisation import Timing, find_timing, is_film
from tests.models.rigs import make_rig_capture
from tests.models.walk import film
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
FRAMES = 240
RING = [0.0, 70.0, 160.0]


def late_by(*frames: float) -> Float64:
    """Moments (FRAMES, K) that views show which are late by so many frames."""
    moments: Float64 = np.arange(20.0, 20 + FRAMES)[:, None] - np.array(frames)
    return moments


def timing_of(keypoints: Float64) -> Timing | None:
    seen = np.asarray(np.isfinite(keypoints).all(-1))
    return find_timing(keypoints, seen.astype(np.float64))


@pytest.mark.parametrize("late", thorough_after(2, [7.0, 3.3, 1.0, -10.0, 0.5]))
def test_a_late_view_is_found(late: float) -> None:
    found = timing_of(film(RING, late_by(0, late, 0)))
    assert found is not None
    assert found.late.tolist() == [False, True, False]
    np.testing.assert_allclose(found.offsets, [[0, late, 0]], atol=0.05)
    assert (found.offsets == np.round(found.offsets)).all() == late.is_integer()


def test_several_views_may_be_late_and_two_are_enough() -> None:
    found = timing_of(film([0, 70, 160, 250], late_by(0, 4, -2.5, 0)))
    assert found is not None
    np.testing.assert_allclose(found.offsets, [[0, 4, -2.5, 0]], atol=0.05)
    pair = timing_of(film([0, 70], late_by(0, 6)))
    assert pair is not None
    np.testing.assert_allclose(pair.offsets, [[0, 6]], atol=0.05)


def test_noise_gaps_and_outliers() -> None:
    rng = np.random.default_rng(3)
    for noise, near in ((5.0, 0.3), (15.0, 0.9)):
        keypoints = film(RING, late_by(0, 0, 4), noise=noise)
        keypoints[rng.random(keypoints.shape[:3]) < 0.2] = np.nan
        wrong = rng.random(keypoints.shape[:3]) < 0.05
        keypoints[wrong] = rng.uniform(0, 1000, (int(wrong.sum()), 2))
        found = timing_of(keypoints)
        assert found is not None
        assert abs(found.offsets[0, 2] - 4) < near
        assert np.abs(found.offsets[0, :2]).max() == 0
        assert 0 < found.sds[2] < near


@pytest.mark.thorough
def test_the_standard_deviation_is_true() -> None:
    z = []
    for seed in range(8):
        found = timing_of(film([0, 70], late_by(0, 2.5), noise=8.0, seed=seed))
        assert found is not None
        z.append((found.offsets[0, 1] - 2.5) / found.sds[1])
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 2.5


def test_views_in_step_are_left_alone() -> None:
    for noise in (0.0, 3.0, 15.0):
        found = timing_of(film(RING, late_by(0, 0, 0), noise=noise))
        assert found is not None
        assert not found.late.any()
        assert not found.unknown.any()
        assert (found.offsets == 0).all()


@pytest.mark.parametrize("frames", thorough_after(1, [slice(0, 30), slice(220, 240), slice(0, 0)]))
def test_a_view_that_shows_little_is_not_late_and_hides_no_other(frames: slice) -> None:
    for late in (0.0, 5.0):
        keypoints = film([*RING, 250], late_by(0, late, 0, 0), noise=1.0)
        shown = keypoints[frames, 3].copy()
        keypoints[:, 3] = np.nan
        keypoints[frames, 3] = shown
        found = timing_of(keypoints)
        assert found is not None
        assert found.late.tolist() == [False, late > 0, False, False]
        np.testing.assert_allclose(found.offsets, [[0, late, 0, 0]], atol=0.05)


def test_a_drift_is_found() -> None:
    moments = late_by(0, 0, 0)
    moments[:, 1] -= np.linspace(1, 4, FRAMES)
    found = timing_of(film(RING, moments))
    assert found is not None
    assert found.late.tolist() == [False, True, False]
    along = np.interp(np.arange(FRAMES), found.frames, found.offsets[:, 1])
    assert np.abs(along - np.linspace(1, 4, FRAMES))[20:-20].max() < 0.15


def test_dropped_frames_are_found() -> None:
    moments = late_by(0, 0, 0)
    moments[130:, 2] += 3  # the view goes on three frames later than it stopped
    found = timing_of(film(RING, moments))
    assert found is not None
    assert found.late.tolist() == [False, False, True]
    np.testing.assert_allclose(found.offsets[:, 2], [0, -3], atol=0.2)
    np.testing.assert_allclose(found.frames, [129, 130], atol=4)


def test_a_cut_does_not_hurt() -> None:
    parts = [film(RING, late_by(0, 0, 3), seed=seed)[:120] for seed in (0, 1)]
    found = timing_of(np.concatenate(parts))
    assert found is not None
    np.testing.assert_allclose(found.offsets, [[0, 0, 3]], atol=0.05)


@pytest.mark.parametrize("late", thorough_after(1, [339.0, -123.0]))
def test_all_that_views_share_is_searched(late: float) -> None:
    """A camera that was started many seconds late: its offset is sure, and it is the right one."""
    moments = np.arange(350.0, 850)[:, None] - np.array([0, late])
    found = timing_of(film([0, 70], moments, noise=3.0))
    assert found is not None
    assert found.late.tolist() == [False, True]
    np.testing.assert_allclose(found.offsets, [[0, late]], atol=0.1)


def test_movements_that_repeat_leave_offsets_open() -> None:
    """A view is late by a part of what repeats, and so may be later or earlier by all of it."""
    swing = 40 + 35 * np.sin(2 * np.pi * (np.arange(450)[:, None] - [0, 20]) / 90)
    found = timing_of(film([0, 70], swing, noise=3.0))
    assert found is not None
    assert found.late[1] + found.unknown[1] == 1
    assert found.unknown[1] or abs(found.offsets[0, 1] - 20) < 1


def test_moving_cameras_and_few_frames_have_no_timing() -> None:
    moving = make_rig_capture(RING, frames=FRAMES, moving=(0, 1, 2), hidden=0)
    found = timing_of(moving.keypoints)
    assert found is None or not found.late.any()
    assert timing_of(film(RING, late_by(0, 5, 0))[:25]) is None
    assert timing_of(film([0], late_by(0))) is None
    assert timing_of(np.full((FRAMES, 2, 5, 2), 7.0)) is None
    assert timing_of(np.full((FRAMES, 2, 5, 2), np.nan)) is None


def test_films_are_distinguished_from_shuffled_frames() -> None:
    keypoints = film(RING, late_by(0, 5, 0), noise=5.0)
    assert is_film(keypoints)
    assert not is_film(np.random.default_rng(0).permutation(keypoints))
    assert not is_film(keypoints[:10])


@pytest.mark.parametrize(
    "late", thorough_after(1, [[0, 12, 0, -12], [0, 10, 3, 0], [0, -12, 12, 5]])
)
def test_short_captures_with_gaps_hardly_determine_offsets(late: list[int]) -> None:
    """Views so late leave so few frames that no uncertainty can be estimated."""
    rng = np.random.default_rng(0)
    moments = np.arange(20.0, 70)[:, None] - np.array(late)
    keypoints = film([0.0, 70.0, 160.0, 250.0], moments, noise=1.0)
    seen = rng.random(keypoints.shape[:3]) > 0.3
    timing = find_timing(np.where(seen[..., None], keypoints, np.nan), seen.astype(np.float64))
    assert timing is None or np.isfinite(timing.offsets).all()
