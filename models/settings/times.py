"""Checking when frames were taken. Imports nothing but NumPy, as `models.settings.keypoints`."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

MIN_FPS = 1e-6  # frames per second: a picture in twelve days
MAX_FPS = 1e5  # beyond any camera that films a subject
MAX_TIME = 1e12  # seconds; any clock's, and still exact to a fraction of a millisecond
MAX_LAG = 50  # frames that an answer may be late to be smoothed by what follows
RATE_TOLERANCE = 0.05  # by which `fps` and the times of the frames may differ

Float64 = NDArray[np.float64]


def check_times(times: ArrayLike, *, frames: int, views: int) -> Float64:
    """Return times in seconds, (N,) or (N, K), or raise ValueError saying why not.

    One time for a frame, or one for each of its views, where every camera has a clock of its own.
    """
    try:
        seconds = np.asarray(times, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError("times must be an array of numbers, in seconds") from error
    if seconds.shape not in ((frames,), (frames, views)):
        raise ValueError(
            f"times must have shape (frames,) = ({frames},) or (frames, views) ="
            f" ({frames}, {views}), got {seconds.shape}"
        )
    if not np.isfinite(seconds).all() or np.abs(seconds).max(initial=0) > MAX_TIME:
        raise ValueError(
            f"times must be finite and at most {MAX_TIME:g} seconds from 0; give every frame a"
            " time, also where a view shows nothing"
        )
    steps = np.diff(seconds, axis=0)
    if (steps <= 0).any():
        first = int(np.nonzero(steps <= 0)[0][0])
        raise ValueError(
            f"times must increase from frame to frame, but that of frame {first + 1} is not after"
            f" that of frame {first}; sort the frames by time and leave out those that occur twice"
        )
    return seconds


def check_rate(fps: float, times: Float64) -> None:
    """Raise ValueError if `times` (N, ...) are not those of so many frames per second."""
    if len(times) < 2:
        return
    rate = 1 / float(np.median(np.diff(times, axis=0)))
    if abs(rate / fps - 1) > RATE_TOLERANCE:
        raise ValueError(
            f"fps is {fps:g}, but most of the times are {1 / rate:g} s apart, which is {rate:g}"
            " frames per second; leave out one of the two, or give times in seconds"
        )
