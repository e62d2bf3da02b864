"""Medians that are one of the numbers."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def lower_median(numbers: ArrayLike, axis: int | None = None, *, keepdims: bool = False) -> Any:
    """Return the median; of an even count the lower of the middle two, so that one occurs.

    `numbers` must not be empty.
    """
    median: NDArray[np.float64] = np.quantile(
        np.asarray(numbers, np.float64), 0.5, axis=axis, method="lower", keepdims=keepdims
    )
    return median
