"""Whatever keypoints come: findings are about what there is, and reading in step loses nothing."""

import logging
from logging.handlers import BufferingHandler

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from models.capture.checks import capture_findings, observed
from models.capture.clocks import Clocks, frames_apart, in_step
from models.capture.frozen import frozen_places
from models.epipolar.order_checks import order_findings
from models.epipolar.synchronisation import find_timing, is_film
from tests.odd_arrays import Float32, bounded, captures, films


@bounded
@given(captures())
def test_findings_name_views_frames_and_keypoints_that_there_are(keypoints: Float32) -> None:
    frames, views, points, _ = keypoints.shape
    for finding in capture_findings(keypoints, image_sizes=[(640, 480)] * views):
        assert set(finding.views) <= set(range(views))
        assert set(finding.keypoints) <= set(range(points))
        for first, last in finding.frames:
            assert 0 <= first <= last < frames


@bounded
@given(captures(), st.integers(0, 3))
def test_a_view_that_shows_nothing_is_found(keypoints: Float32, view: int) -> None:
    frames, views, points, _ = keypoints.shape
    assume(points >= 4)  # fewer say nothing of a camera
    hidden = 1 + view % views
    clear = np.random.default_rng(0).uniform(0, 500, (frames, 1, points, 2)).astype(np.float32)
    seen = np.concatenate((clear, keypoints), axis=1)
    seen[:, hidden] = np.nan
    found = [one for one in capture_findings(seen) if one.code == "view_never_seen"]
    assert hidden in {number for one in found for number in one.views}
    assert 0 not in {number for one in found for number in one.views}


@bounded
@given(captures(), st.floats(0.5, 240))
def test_views_that_are_in_step_are_read_as_they_are(keypoints: Float32, fps: float) -> None:
    times = np.arange(len(keypoints)) / fps
    views = keypoints.shape[1]
    none_late = Clocks(times[:1], np.zeros((1, views)))
    for options in (times, np.repeat(times[:, None], views, axis=1)):
        read, confidence = in_step(keypoints, None, options, none_late)
        np.testing.assert_array_equal(read, keypoints)
        assert confidence is None
        assert frames_apart(options, none_late) == 0


@bounded
@given(captures(), st.floats(-3, 3), st.integers(1, 3))
def test_a_late_view_is_never_read_where_it_showed_nothing(
    keypoints: Float32, late: float, view: int
) -> None:
    views = keypoints.shape[1]
    times = np.arange(len(keypoints), dtype=np.float64)
    offsets = np.zeros((1, views))
    offsets[0, view % views] = late if view % views else 0.0
    read, _ = in_step(keypoints, None, times, Clocks(times[:1], offsets))
    assert read.shape == keypoints.shape
    never = ~observed(keypoints).any(axis=0)  # (K, P)
    assert not observed(read)[:, never].any()
    np.testing.assert_array_equal(read[:, 0], keypoints[:, 0])


@pytest.mark.thorough
@settings(bounded, max_examples=30)  # one takes up to half a second
@given(films())
def test_no_check_fails(keypoints: Float32) -> None:
    """They are called one by one: inside a fit a check that fails is left out, and would be so."""
    seen = observed(keypoints)
    frozen_places(keypoints, seen)
    pixels, weights = keypoints.astype(np.float64), seen.astype(np.float64)
    assert is_film(pixels) in (True, False)
    timing = find_timing(pixels, weights)
    if timing is not None:
        assert np.isfinite(timing.offsets).all()
        assert not (timing.late & timing.unknown).any()
    with np.errstate(all="ignore"):
        order_findings(pixels, weights)


@bounded
@given(films())
def test_findings_of_films_are_made_without_a_failure(keypoints: Float32) -> None:
    handler = BufferingHandler(1000)
    logging.getLogger("models.findings.advice").addHandler(handler)
    try:
        capture_findings(keypoints, image_sizes=[(640, 480)] * keypoints.shape[1])
    finally:
        logging.getLogger("models.findings.advice").removeHandler(handler)
    assert not handler.buffer


def test_a_blind_view_does_not_hide_what_is_stuck_in_another() -> None:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 900, (60, 3, 8, 2)).astype(np.float32)
    keypoints[:, 2] = np.nan
    keypoints[::3, 1, 4] = 0
    codes = [finding.code for finding in capture_findings(keypoints)]
    assert sorted(codes) == ["keypoint_frozen", "view_never_seen"]
