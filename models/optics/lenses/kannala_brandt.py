"""OpenCV's fisheye lens with four coefficients k1 to k4.

    (x', y') = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (a, b) / r

with r^2 = a^2 + b^2 and the angle theta = atan r to the axis of the lens (Kannala & Brandt, *A
generic camera model and calibration method*, 2006); see
https://docs.opencv.org/4.x/db/d58/group__calib3d__fisheye.html.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import inner
from models.optics.lenses.bending import Bending
from models.settings.calibration import LensName, LiftedLensName

Float64 = NDArray[np.float64]

NAME: LensName = "fisheye"
LIFTED_AS: LiftedLensName = "fisheye"

BARREL = -0.1  # a pinhole's mean k1 from which a lens may be a fisheye, whose k1 would be -1/3
NEAR_AXIS = 1e-8  # r^2 below which the first terms of the series in r are used


def start_from_pinhole(distortion: Float64) -> Float64 | None:
    """Return no bending beyond the fisheye's own where pinholes (n, 8) bend inwards enough.

    Near its axis a fisheye looks like a pinhole with a first radial coefficient of -1/3.
    """
    return None if distortion[:, 0].mean() > BARREL else np.zeros_like(distortion)


@inner
def bend(a: float, b: float, k: Float64) -> tuple[float, float]:
    """Bend the direction (a, b) by the first four of the coefficients k (8,)."""
    squared = a * a + b * b
    if squared < NEAR_AXIS:
        return a, b
    radius = math.sqrt(squared)
    gain = _angle_behind(math.atan(radius), k) / radius
    return gain * a, gain * b


@inner
def differentiate(a: float, b: float, k: Float64) -> Bending:
    """Bend the direction (a, b) by the first four of the coefficients k (8,), with derivatives."""
    squared = a * a + b * b
    radius = math.sqrt(max(squared, NEAR_AXIS))
    angle = math.atan(radius)
    t = angle * angle
    gain, slope = 1.0, k[0] - 1 / 3  # of (x', y') over (a, b), and its derivative by r^2
    if squared >= NEAR_AXIS:
        gain = _angle_behind(angle, k) / radius
        rate = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * 9 * k[3])))
        slope = (rate / (1 + squared) - gain) / (2 * squared)
    cross = 2 * slope * a * b
    by_k1 = t * angle / radius
    return Bending(
        gain * a,
        gain * b,
        gain + 2 * slope * a * a,
        cross,
        cross,
        gain + 2 * slope * b * b,
        by_k1 * a,
        by_k1 * b,
        by_k1 * t * a,
        by_k1 * t * b,
    )


@inner
def _angle_behind(angle: float, k: Float64) -> float:
    """Return the angle, in radians, at which a ray leaves the lens after entering at `angle`."""
    t = angle * angle
    behind: float = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))
    return behind
