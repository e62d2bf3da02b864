"""When frames were taken: what is accepted, and what the errors name."""

import numpy as np
import pytest

from models.settings.times import check_rate, check_times


def test_times_of_frames_and_of_views_are_accepted() -> None:
    seconds = 1.7e9 + np.arange(5) / 50
    np.testing.assert_array_equal(check_times(seconds, frames=5, views=3), seconds)
    by_view = seconds[:, None] + [0, 0.004, 100]
    np.testing.assert_array_equal(check_times(by_view.tolist(), frames=5, views=3), by_view)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 1, 2], "shape"),
        ([[0, 1], [1, 2]], "shape"),
        ([0, 0.02, 0.02, 0.04], "that of frame 2 is not after that of frame 1"),
        ([0, 3, 2, 4], "frame 2"),
        ([0, np.nan, 2, 3], "finite"),
        ([0, 1, 2, 1e13], "at most"),
        (["a", "b", "c", "d"], "numbers"),
    ],
)
def test_other_times_are_refused(times: list[object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_times(times, frames=4, views=3)  # type: ignore[arg-type]


def test_rate_and_times_must_agree() -> None:
    check_rate(50, np.arange(10) / 50.5)
    with pytest.raises(ValueError, match="25 frames per second"):
        check_rate(50, np.arange(10) / 25)
