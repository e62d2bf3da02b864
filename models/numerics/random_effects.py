"""Means of measurements with known variances, and the true variation between them."""

import numpy as np
from numpy.typing import NDArray

from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]

BISECTIONS = 60


def random_effects(measured: Float64, variances: Float64) -> tuple[Float64, Float64]:
    """Return means (E,) of measurements (N, E), and their scatter (E,) beyond their variances.

    Variances are infinite where nothing was measured. The scatter is the one under which the
    squared residuals have their expected size; 0 if they are smaller without any (Paule and Mandel,
    *Consensus values and weighting factors*, 1982).
    """
    degrees = np.isfinite(variances).sum(0) - 1
    low, high = np.zeros(measured.shape[1]), np.square(measured).max(0, initial=0.0)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        weights = 1 / (variances + middle)
        means = (weights * measured).sum(0) / weights.sum(0).clip(TINY)
        wide = (weights * np.square(measured - means)).sum(0) < degrees
        low, high = np.where(wide, low, middle), np.where(wide, middle, high)
    return means, np.sqrt(low)
