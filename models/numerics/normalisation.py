"""Bringing points to one place and one size, compiled: structures, and views by their weights."""

import math
from typing import Any, NamedTuple

from numpy.typing import NDArray

from models.numerics.compiled import inner

Floats = NDArray[Any]  # of 32 or 64 bits

LEAST_MEAN_SQUARE = 1e-12  # of the radius: less would divide by zero


class Placement(NamedTuple):
    """Where a view's keypoints lie: `normalised * size + (x, y)` gives them back."""

    x: float
    y: float
    size: float


@inner
def normalise_into(points: Floats, out: Floats) -> float:
    """Centre points (P, D), bring them to root-mean-square radius 1; return the radius."""
    count, width = points.shape
    for d in range(width):
        mean = 0.0
        for p in range(count):
            mean += points[p, d]
        mean /= count
        for p in range(count):
            out[p, d] = points[p, d] - mean
    squared = 0.0
    for p in range(count):
        for d in range(width):
            squared += float(out[p, d]) ** 2
    radius = math.sqrt(max(squared / count, LEAST_MEAN_SQUARE))
    for p in range(count):
        for d in range(width):
            out[p, d] /= radius
    return radius


@inner
def normalise_view_into(
    keypoints: Floats, weights: Floats, least_weight: float, least_size: float, out: Floats
) -> Placement:
    """Centre a view (P, 2) by its weights (P,), bring it to weighted root-mean-square radius 1.

    What has no weight becomes 0, whatever it was. The sum of the weights counts as `least_weight`
    at least, the size as `least_size`. `out` may be the keypoints themselves.
    """
    count = len(weights)
    whole, x, y = 0.0, 0.0, 0.0
    for p in range(count):
        weight = weights[p]
        if weight > 0:
            whole += weight
            x += weight * keypoints[p, 0]
            y += weight * keypoints[p, 1]
    whole = max(whole, least_weight)
    x, y, squared = x / whole, y / whole, 0.0
    for p in range(count):
        if weights[p] > 0:
            out[p, 0], out[p, 1] = keypoints[p, 0] - x, keypoints[p, 1] - y
            squared += weights[p] * (out[p, 0] ** 2 + out[p, 1] ** 2)
        else:
            out[p, 0], out[p, 1] = 0, 0
    size = max(math.sqrt(squared / whole), least_size)
    for p in range(count):
        out[p, 0] /= size
        out[p, 1] /= size
    return Placement(x, y, size)
