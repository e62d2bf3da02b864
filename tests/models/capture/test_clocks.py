"""Views read at other times than those of their own frames."""

import numpy as np

from models.capture.clocks import Clocks, positions_in_step, read_at, times_of_views

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
        positions = positions_in_step(times_of_views(TIMES, 2), clocks)
        pixels, _ = read_at(keypoints, None, positions)
        np.testing.assert_array_equal(pixels[:, 0], keypoints[:, 0])
        there = np.isfinite(pixels[:, 1, 0, 0])
        assert there.sum() == FRAMES - np.ceil(abs(late) * 50)
        np.testing.assert_allclose(
            pixels[there, 1], pixels[there, 0], atol=0.01
        )  # linear at the ends


def test_times_of_the_views_are_honoured() -> None:
    times = np.stack((TIMES, TIMES + 0.013, 1.1 * TIMES), 1)
    pixels, _ = read_at(parabolas(times), None, positions_in_step(times))
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
    pixels, _ = read_at(keypoints, None, positions_in_step(times_of_views(TIMES, 2), clocks))
    there = np.isfinite(pixels[:, 1, 0, 0])
    assert there[3:36].all()
    # A moment is read with the offset of its own time: what changes within it is of second order.
    np.testing.assert_allclose(pixels[there, 1], pixels[there, 0], atol=0.03)


def test_gaps_cuts_and_pauses_stay_gaps() -> None:
    keypoints = parabolas(np.stack((TIMES, TIMES), 1))
    keypoints[10, 1, 2] = np.nan
    keypoints[25:] += 500  # a cut
    clocks = Clocks(np.zeros(1), np.array([[0.0, 0.01]]))  # half a frame
    pixels, confidence = read_at(
        keypoints,
        np.ones((FRAMES, 2, 5), np.float32),
        positions_in_step(times_of_views(TIMES, 2), clocks),
    )
    assert confidence is not None
    gone = np.isnan(pixels[:, 1, :, 0])
    np.testing.assert_array_equal(np.flatnonzero(gone[:, 2]), [9, 10, 24, 39])
    np.testing.assert_array_equal(np.flatnonzero(gone[:, 0]), [24, 39])
    np.testing.assert_array_equal(confidence[:, 1] == 0, gone)
    paused = TIMES + (np.arange(FRAMES) >= 15) * 1.0
    positions = positions_in_step(times_of_views(paused, 2), clocks)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(positions[:, 1])), [14, 39])
