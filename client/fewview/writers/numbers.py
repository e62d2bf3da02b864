"""What writers of text share."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.errors import FormatError

OFF = 0.25  # of a frame: times of a constant rate that lacks frames are not further off
MOST_MISSING = 20  # times the frames that there are


def text(number: float) -> str:
    """Return a number with as many digits as float32 has, '' for NaN."""
    return "" if math.isnan(number) else f"{number:.9g}"


def texts(numbers: NDArray[np.float64]) -> list[str]:
    """Return numbers of any shape in their order, as `text` has them."""
    return [text(number) for number in numbers.ravel().tolist()]


def time_text(seconds: float) -> str:
    """Return a time to the nanosecond, or to what a float64 has."""
    return f"{seconds:.9f}".rstrip("0").rstrip(".")


def columns_of(animation: Animation) -> dict[str, NDArray[np.float64]]:
    """Return what tables have of every point, (N, P) each: x, y, z and, where it is known, sd."""
    columns = {axis: animation.points[..., place] for place, axis in enumerate("xyz")}
    return columns if animation.points_sd is None else columns | {"sd": animation.points_sd}


def evened(animation: Animation, format: str) -> Animation:
    """Return an animation with a constant rate: frames that are missing become gaps.

    Raises
    ------
    FormatError
        If times are not those of a constant rate, or far more frames are missing than there are.
    """
    if animation.even:
        return animation
    steps = (animation.seconds - animation.seconds[0]) * animation.rate
    places = np.rint(steps).astype(np.int64)
    count = int(places[-1]) + 1
    regular = np.all(np.abs(steps - places) <= OFF) and np.all(np.diff(places) > 0)
    if not regular or count > MOST_MISSING * len(places):
        raise FormatError(
            f"{format} has a constant frame rate, and the times of the frames are uneven: "
            "interpolate to even times first, or write CSV, TRC, JSON lines or glTF"
        )

    def spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
        regular = np.full((count, *values.shape[1:]), np.nan)
        regular[places] = values
        return regular

    return replace(
        animation,
        points=spread(animation.points),
        points_sd=None if animation.points_sd is None else spread(animation.points_sd),
        times=None,
        fps=animation.rate,
        numbers=None,
    )
