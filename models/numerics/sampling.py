"""Samples of frames."""

import numpy as np
from numpy.typing import NDArray


def evenly_spread(count: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` of the numbers below `count`, rising and evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
