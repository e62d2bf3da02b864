"""Views read at other times than those of their own frames."""

import numpy as np

from models.capture.clocks import Clocks, in_step

FRAMES = 40
TIMES = np.arange(FRAMES) / 50


def parabolas(moments: np.ndarray) -> np.ndarray:
    """Five keypoints (T, K, 5, 2) that fly along parabolas, at moments (T, K) in seconds."""
    a, b = np.arange(1, 6) * 30.0, np.arange(5) * 7.0
    t = moments[..., None]
    return np.stack((100 + a * t, 50 + b * t + 40 * t**2), -1).astype(np.float32)


def test_a_late_view_is_read_later() -> None:
    for late in (0.04, 0.047, -0.1):
        keypoints = parabolas(np.stack((TIMES, TIMES - late), 1))
        clocks = Clocks(np.zeros(1), np.array([[0.0, late]]))
        pixels, _ = in_step(keypoints, None, TIMES, clocks)
        np.testing.assert_array_equal(pixels[:, 0], keypoints[:, 0])
        there = np.isfinite(pixels[:, 1, 0, 0])
        assert there.sum() == FRAMES - np.ceil(abs(late) * 50)
        np.testing.assert_allclose(
            pixels[there, 1], pixels[there, 0], atol=0.01
        )  # linear at the ends


def test_times_of_the_views_are_honoured() -> None:
    times = np.stack((TIMES, TIMES + 0.013, 1.1 * TIMES), 1)
    pixels, _ = in_step(parabolas(times), None, times)
    for view in (1, 2):
        there = np.isfinite(pixels[:, view, 0, 0])
        assert there.sum() > 30
        np.testing.assert_allclose(
            pixels[there, view], pixels[there, 0], atol=0.01
        )  # linear at the ends


def test_a_drift_changes_from_frame_to_frame() -> None:
    late = np.interp(TIMES, [0, 0.6], [0.01, 0.015])
    keypoints = parabolas(np.stack((TIMES, TIMES - late), 1))
    clocks = Clocks(np.array([0, 0.6]), np.array([[0, 0.01], [0, 0.015]]))
    pixels, _ = in_step(keypoints, None, TIMES, clocks)
    there = np.isfinite(pixels[:, 1, 0, 0])
    assert there[3:36].all()
    # A moment is read with the offset of its own time: what changes within it is of second order.
    np.testing.assert_allclose(pixels[there, 1], pixels[there, 0], atol=0.03)


def test_gaps_cuts_and_pauses_stay_gaps() -> None:
    keypoints = parabolas(np.stack((TIMES, TIMES), 1))
    keypoints[10, 1, 2] = np.nan
    keypoints[25:] += 500  # a cut
    clocks = Clocks(np.zeros(1), np.array([[0.0, 0.01]]))  # half a frame
    pixels, confidence = in_step(keypoints, np.ones((FRAMES, 2, 5), np.float32), TIMES, clocks)
    assert confidence is not None
    gone = np.isnan(pixels[:, 1, :, 0])
    np.testing.assert_array_equal(np.flatnonzero(gone[:, 2]), [9, 10, 24, 39])
    np.testing.assert_array_equal(np.flatnonzero(gone[:, 0]), [24, 39])
    np.testing.assert_array_equal(confidence[:, 1] == 0, gone)
    paused = TIMES + (np.arange(FRAMES) >= 15) * 1.0
    pixels, _ = in_step(parabolas(np.stack((paused, paused), 1)), None, paused, clocks)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(pixels[:, 1, 0, 0])), [14, 39])


def test_a_frame_that_is_missing_is_bridged() -> None:
    times = np.delete(TIMES, [12, 30])
    clocks = Clocks(np.zeros(1), np.array([[0.0, 0.033]]))
    pixels, _ = in_step(parabolas(np.stack((times, times - 0.033), 1)), None, times, clocks)
    assert np.isfinite(pixels[:-2, 1]).all()
    np.testing.assert_allclose(pixels[:-2, 1], pixels[:-2, 0], atol=0.02)


def test_what_is_stuck_at_a_pixel_stays_there() -> None:
    keypoints = parabolas(np.stack((TIMES, TIMES), 1))
    keypoints[:, 1, 3] = 17.3
    pixels, _ = in_step(keypoints, None, TIMES, Clocks(np.zeros(1), np.array([[0.0, 0.007]])))
    assert np.unique(pixels[:-1, 1, 3]).tolist() == [np.float32(17.3)]
