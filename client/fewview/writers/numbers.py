"""What writers of text share."""

import math

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.errors import FormatError


def text(number: float) -> str:
    """Return a number with as many digits as float32 has, '' for NaN."""
    return "" if math.isnan(number) else f"{number:.9g}"


def texts(numbers: NDArray[np.float64]) -> list[str]:
    """Return numbers of any shape in their order, as `text` has them."""
    return [text(number) for number in numbers.ravel().tolist()]


def time_text(seconds: float) -> str:
    """Return a time to the nanosecond, or to what a float64 has."""
    return f"{seconds:.9f}".rstrip("0").rstrip(".")


def demand_even(animation: Animation, format: str) -> None:
    """Raise `FormatError` where times are not those of a constant rate."""
    if not animation.even:
        raise FormatError(
            f"{format} has a constant frame rate, and the times of the frames are uneven: "
            "interpolate to even times first, or write CSV, TRC, JSON lines or glTF"
        )
