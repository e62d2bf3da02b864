"""Chains of points that bend little, estimated from measurements of each point."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled

Float64 = NDArray[np.float64]


class Chain(NamedTuple):
    """M points in Q coordinates, one after the other, and their variances."""

    points: Float64  # (M, Q)
    variances: Float64  # (M, Q) of these
    doubts: Float64  # (M - 2, Q) variances of the second differences


def smooth_chain(sums: Float64, counts: Float64, rates: Float64, scales: Float64) -> Chain:
    """Return the posterior of M >= 3 points, each measured any number of times.

    Measurements have white noise of variance 1. Second differences of the points have the prior
    variance `scales` times `rates`; there is no other prior. Coordinates are independent.

    Parameters
    ----------
    sums
        (M, Q) sums of the measurements of a point.
    counts
        (M,) numbers of measurements, not necessarily whole. Two or more are positive.
    rates, scales
        (Q,) and (M - 2,), positive.
    """
    chain = Chain(np.empty_like(sums), np.empty_like(sums), np.empty((len(scales), len(rates))))
    _smooth_into(np.ascontiguousarray(sums), counts, rates, scales, chain)
    return chain


@compiled
def _smooth_into(
    sums: Float64, counts: Float64, rates: Float64, scales: Float64, chain: Chain
) -> None:
    """Factorise each coordinate's matrix of five diagonals as L D L^T, and solve.

    Of the inverse, the same diagonals are found from the end on (Takahashi, Fagan and Chen,
    *Formation of a Sparse Bus Impedance Matrix*, 1973).
    """
    count, size = sums.shape
    # Diagonals of the sum of all d d^T / scale, where d takes a second difference.
    main, next_one, next_two = np.zeros(count), np.zeros(count), np.zeros(count)
    for j in range(count - 2):
        precision = 1.0 / scales[j]
        main[j] += precision
        main[j + 1] += 4.0 * precision
        main[j + 2] += precision
        next_one[j] -= 2.0 * precision
        next_one[j + 1] -= 2.0 * precision
        next_two[j] += precision
    pivots, x = np.empty(count), np.empty(count)
    # Below the diagonal of L, and the diagonals of the inverse; with two rows of zeros at the end.
    one, two = np.zeros(count + 2), np.zeros(count + 2)
    own, with_one, with_two = np.zeros(count + 2), np.zeros(count + 2), np.zeros(count + 2)
    for q in range(size):
        rate = rates[q]
        for i in range(count):
            pivot, below, value = counts[i] + main[i] / rate, next_one[i] / rate, sums[i, q]
            if i > 0:
                pivot -= one[i - 1] ** 2 * pivots[i - 1]
                below -= two[i - 1] * pivots[i - 1] * one[i - 1]
                value -= one[i - 1] * x[i - 1]
            if i > 1:
                pivot -= two[i - 2] ** 2 * pivots[i - 2]
                value -= two[i - 2] * x[i - 2]
            pivots[i], x[i] = pivot, value
            one[i], two[i] = below / pivot, next_two[i] / rate / pivot
        one[count - 1], two[count - 1], two[count - 2] = 0.0, 0.0, 0.0
        for i in range(count - 1, -1, -1):
            x[i] /= pivots[i]
            if i + 1 < count:
                x[i] -= one[i] * x[i + 1]
            if i + 2 < count:
                x[i] -= two[i] * x[i + 2]
            with_one[i] = -(one[i] * own[i + 1] + two[i] * with_one[i + 1])
            with_two[i] = -(one[i] * with_one[i + 1] + two[i] * own[i + 2])
            own[i] = 1.0 / pivots[i] - one[i] * with_one[i] - two[i] * with_two[i]
            chain.points[i, q], chain.variances[i, q] = x[i], own[i]
        for j in range(count - 2):
            unsure = own[j] + 4.0 * own[j + 1] + own[j + 2] + 2.0 * with_two[j]
            unsure -= 4.0 * (with_one[j] + with_one[j + 1])
            chain.doubts[j, q] = max(unsure, 0.0)
