"""Smoothing numbers that change steadily: an integrated Wiener process under white noise.

The state of a process is its value and its velocity, whose changes are white noise (Särkkä &
Solin, *Applied Stochastic Differential Equations*, 2019, section 6.2). The Kalman filter runs
forwards, the smoother of Rauch, Tung and Striebel (1965) backwards. Value and velocity at the
beginning have a flat prior.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

UNKNOWN = 1e9  # variance of values and velocities at the beginning, in variances of the noise


class Smoothed(NamedTuple):
    """D processes at N times, and the statistics from which their rates are learnt."""

    values: Float64  # (D, N)
    variances: Float64  # (D, N) of these
    forces: Float64  # (D, N, 2) change of value and velocity before a time, over the rate
    doubts: Float64  # (D, N) posterior variance of that change, for a rate of 1
    likelihoods: Float64  # (D,) log, of the numbers, up to a constant


def smooth(
    numbers: Float64,
    steps: Float64,
    seen: Bool,
    rates: Float64,
    noise: float,
    start: Float64 | None = None,
) -> Smoothed:
    """Smooth D processes that are independent of each other.

    Parameters
    ----------
    numbers
        (D, N) the values with white noise.
    steps
        (N,) time since the one before; 0 where a process starts anew, as at the first.
    seen
        (N,) whether there are numbers at that time.
    rates
        (D,) variance of a velocity's change in a unit of time.
    noise
        Standard deviation of the numbers.
    start
        (D, 5) states at the time before the first, as `advance` returns them; None if they are
        unknown, and the first of the `steps` is 0.
    """
    numbers = np.ascontiguousarray(numbers)
    count, times = numbers.shape
    smoothed = Smoothed(
        np.empty((count, times)),
        np.empty((count, times)),
        np.zeros((count, times, 2)),
        np.zeros((count, times)),
        np.zeros(count),
    )
    before = np.zeros((count, 5)) if start is None else start
    _smooth_into(numbers, steps, seen, rates, noise**2, before, smoothed)
    return smoothed


def advance(
    states: Float64, numbers: Float64, step: float, seen: bool, rates: Float64, noise: float
) -> Float64:
    """Filter: return the states (D, 5) at the time of `numbers` (D,), a `step` after `states`.

    A state is expected value and velocity, and variance, covariance and variance of these. The
    other parameters are those of `smooth`; with a step of 0 a process starts anew.
    """
    after = np.empty((len(numbers), 5))
    _advance_into(states, numbers, step, seen, rates, noise**2, after)
    return after


def summed_products(smoothed: Smoothed, steps: Float64) -> Float64:
    """Return the statistics (D, D) from which rates are learnt, over the product of two rates.

    This is the expectation of the changes' products under their covariance for a rate of 1, summed
    over the times and both numbers of a state, without the posterior variance of the changes.
    """
    value, velocity = smoothed.forces[..., 0], smoothed.forces[..., 1]  # (D, N)
    mixed: Float64 = (value * (steps**2 / 2)) @ velocity.T
    total: Float64 = (value * (steps**3 / 3)) @ value.T + (velocity * steps) @ velocity.T
    return total + mixed + mixed.T


@inner
def _predicted(
    state: Float64, number: float, h: float, rate: float, variance: float
) -> tuple[float, float, float, float, float]:
    """Return the state a step after another; with a step of 0, the prior of a new process."""
    if h <= 0:
        return number, 0.0, UNKNOWN * variance, 0.0, UNKNOWN * variance
    x, v, a, b, c = state
    return (
        x + h * v,
        v,
        a + 2 * h * b + h * h * c + rate * h * h * h / 3,
        b + h * c + rate * h * h / 2,
        c + rate * h,
    )


@compiled
def _advance_into(
    states: Float64,
    numbers: Float64,
    step: float,
    seen: bool,
    rates: Float64,
    variance: float,
    out: Float64,
) -> None:
    for d in range(len(numbers)):
        x, v, a, b, c = _predicted(states[d], numbers[d], step, rates[d], variance)
        if seen:
            expected, off = a + variance, numbers[d] - x
            value, velocity = a / expected, b / expected
            x, v = x + value * off, v + velocity * off
            a, b, c = a - value * a, b - value * b, c - velocity * b
        out[d, 0], out[d, 1], out[d, 2], out[d, 3], out[d, 4] = x, v, a, b, c


@compiled
def _smooth_into(
    numbers: Float64,
    steps: Float64,
    seen: Bool,
    rates: Float64,
    variance: float,
    start: Float64,
    out: Smoothed,
) -> None:
    count, times = numbers.shape
    # Of each time: expected value and velocity, and the three numbers of their covariance, before
    # it was seen and after.
    before, after = np.empty((times, 5)), np.empty((times, 5))
    for d in range(count):
        rate = rates[d]
        for t in range(times):
            state = after[t - 1] if t > 0 else start[d]
            x, v, a, b, c = _predicted(state, numbers[d, t], steps[t], rate, variance)
            before[t, 0], before[t, 1], before[t, 2], before[t, 3], before[t, 4] = x, v, a, b, c
            if seen[t]:
                expected, off = a + variance, numbers[d, t] - x
                value, velocity = a / expected, b / expected
                out.likelihoods[d] -= 0.5 * (math.log(expected) + off * off / expected)
                x += value * off
                v += velocity * off
                c -= velocity * b
                b -= value * b
                a -= value * a
            after[t, 0], after[t, 1], after[t, 2], after[t, 3], after[t, 4] = x, v, a, b, c
        x, v, a, b, c = after[times - 1]
        out.values[d, times - 1], out.variances[d, times - 1] = x, a
        for t in range(times - 2, -1, -1):
            h = steps[t + 1]
            y, w, p, q, r = after[t]
            if h > 0:
                _, _, e, f, g = before[t + 1]
                determinant = e * g - f * f
                e, f, g = g / determinant, -f / determinant, e / determinant  # inverse
                # Gain: covariance of this state with the next one, over that of the next.
                i = (p + h * q) * e + q * f
                j = (p + h * q) * f + q * g
                k = (q + h * r) * e + r * f
                m = (q + h * r) * f + r * g
                off, turn = x - before[t + 1, 0], v - before[t + 1, 1]
                x, v = y + i * off + j * turn, w + k * off + m * turn
                out.forces[d, t + 1, 0] = e * off + f * turn
                out.forces[d, t + 1, 1] = f * off + g * turn
                a, b, c = a - before[t + 1, 2], b - before[t + 1, 3], c - before[t + 1, 4]
                # Information on the forces: inverse times minus (a, b, c), times inverse.
                known_0 = -(e * e * a + 2 * e * f * b + f * f * c)
                known_1 = -(e * f * a + (e * g + f * f) * b + f * g * c)
                known_2 = -(f * f * a + 2 * f * g * b + g * g * c)
                known = known_0 * h**3 / 3 + known_1 * h**2 + known_2 * h
                out.doubts[d, t + 1] = max(2 * rate - rate * rate * known, 0.0)
                a, b, c = (
                    p + i * i * a + 2 * i * j * b + j * j * c,
                    q + i * k * a + (i * m + j * k) * b + j * m * c,
                    r + k * k * a + 2 * k * m * b + m * m * c,
                )
            else:
                x, v, a, b, c = y, w, p, q, r
            out.values[d, t], out.variances[d, t] = x, a
