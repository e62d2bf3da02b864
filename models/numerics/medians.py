"""Medians that are always one of the numbers, and medians of normal numbers."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.numerics.compiled import inner

Float64 = NDArray[np.float64]

# Of normal numbers: their standard deviation over their median absolute deviation, and the median
# length of a pair of deviation 1, and of its square.
NORMAL = 1.4826
MEDIAN_OF_SQUARES = 2 * math.log(2)
RAYLEIGH = math.sqrt(MEDIAN_OF_SQUARES)


def lower_median(numbers: ArrayLike, axis: int | None = None, *, keepdims: bool = False) -> Any:
    """Return the median; of an even count the lower of the middle two.

    `numbers` must not be empty.
    """
    median: NDArray[np.float64] = np.quantile(
        np.asarray(numbers, np.float64), 0.5, axis=axis, method="lower", keepdims=keepdims
    )
    return median


@inner
def median_of(numbers: Float64) -> float:
    """Return the lower median of numbers (N,), at least one and none NaN; it changes their order.

    Hoare's selection: after each round the one sought lies between `low` and `high`.
    """
    low, high = 0, len(numbers) - 1
    middle = high // 2
    while low < high:
        pivot, i, j = numbers[middle], low, high
        while i <= j:
            while numbers[i] < pivot:
                i += 1
            while pivot < numbers[j]:
                j -= 1
            if i <= j:
                numbers[i], numbers[j] = numbers[j], numbers[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    return float(numbers[middle])
