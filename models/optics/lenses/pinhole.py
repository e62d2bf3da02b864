"""OpenCV's pinhole lens with eight coefficients, in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6.

    x' = L a + 2 p1 a b + p2 (r^2 + 2 a^2),    L = (1 + k1 r^2 + k2 r^4 + k3 r^6)
    y' = L b + p1 (r^2 + 2 b^2) + 2 p2 a b         / (1 + k4 r^2 + k5 r^4 + k6 r^6)

with r^2 = a^2 + b^2; see https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html.
"""

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import inner
from models.optics.lenses.bending import Bending
from models.settings.calibration import LensName, LiftedLensName

Float64 = NDArray[np.float64]

NAME: LensName = "pinhole"
LIFTED_AS: LiftedLensName = "perspective"


def start_from_pinhole(distortion: Float64) -> Float64 | None:
    """Return None: a pinhole solution has been tried with this model."""
    return None


@inner
def bend(a: float, b: float, k: Float64) -> tuple[float, float]:
    """Bend the direction (a, b) by the coefficients k (8,)."""
    squared = a * a + b * b
    gain = _numerator(squared, k) / _denominator(squared, k)
    return (
        gain * a + (2 * k[2] * a * b + k[3] * (squared + 2 * a * a)),
        gain * b + (k[2] * (squared + 2 * b * b) + 2 * k[3] * a * b),
    )


@inner
def differentiate(a: float, b: float, k: Float64) -> Bending:
    """Bend the direction (a, b) by the coefficients k (8,), with derivatives."""
    squared = a * a + b * b
    low = _denominator(squared, k)
    gain = _numerator(squared, k) / low
    slope = (  # of the gain L by r^2
        k[0]
        + squared * (2 * k[1] + 3 * squared * k[4])
        - gain * (k[5] + squared * (2 * k[6] + 3 * squared * k[7]))
    ) / low
    by_k1 = squared / low
    p1, p2 = k[2], k[3]
    cross = 2 * slope * a * b + 2 * (p1 * a + p2 * b)
    return Bending(
        gain * a + (2 * p1 * a * b + p2 * (squared + 2 * a * a)),
        gain * b + (p1 * (squared + 2 * b * b) + 2 * p2 * a * b),
        gain + 2 * slope * a * a + (2 * p1 * b + 6 * p2 * a),
        cross,
        cross,
        gain + 2 * slope * b * b + (6 * p1 * b + 2 * p2 * a),
        by_k1 * a,
        by_k1 * b,
        by_k1 * squared * a,
        by_k1 * squared * b,
    )


@inner
def _numerator(squared: float, k: Float64) -> float:
    numerator: float = 1 + squared * (k[0] + squared * (k[1] + squared * k[4]))
    return numerator


@inner
def _denominator(squared: float, k: Float64) -> float:
    denominator: float = 1 + squared * (k[5] + squared * (k[6] + squared * k[7]))
    return denominator
