"""Perspective and fisheye lenses: pixels of points in a camera's frame, with analytic derivatives.

Pinhole lenses have OpenCV's distortion (k1, k2, p1, p2, k3, k4, k5, k6), fisheye lenses OpenCV's
(k1, k2, k3, k4): https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and group__calib3d__fisheye
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.numerics.compiled import compiled, inner
from models.numerics.threads import room

COEFFICIENTS = 8
TINY = 1e-8  # squared radius below which a fisheye's series is used
NEAR = 1e-6  # depths nearer to 0 than this count as this


class Optics(NamedTuple):
    """Lenses of K views."""

    focals: Tensor  # (K, 2) pixels, along x and y
    centres: Tensor  # (K, 2) principal points, pixels
    distortion: Tensor  # (K, 8) unitless, 0 where unused
    fisheye: Tensor  # (K,) bool


class Lenses(NamedTuple):
    """The same as arrays, for compiled functions."""

    focals: NDArray[np.float64]
    centres: NDArray[np.float64]
    distortion: NDArray[np.float64]
    fisheye: NDArray[np.bool_]


def image(points: Tensor, optics: Optics) -> Tensor:
    """Pixels (..., K, P, 2) of points (..., K, P, 3) in the cameras' frames."""
    contiguous = np.ascontiguousarray(points.numpy())
    pixels = room(*contiguous.shape[:-1], 2)
    views, count = contiguous.shape[-3:-1]
    _image(
        contiguous.reshape(-1, views, count, 3), lenses(optics), pixels.reshape(-1, views, count, 2)
    )
    return torch.from_numpy(pixels)


def lenses(optics: Optics) -> Lenses:
    """Lay out lenses for compiled functions."""
    focals, centres, distortion, fisheye = (np.ascontiguousarray(a.numpy()) for a in optics)
    return Lenses(focals, centres, distortion, fisheye)


@compiled
def _image(points: NDArray[np.float64], glass: Lenses, pixels: NDArray[np.float64]) -> None:
    frames, views, count, _ = points.shape
    for n in range(frames):
        for k in range(views):
            for p in range(count):
                see(points[n, k, p], glass, k, pixels[n, k, p])


@inner
def see(point: NDArray[np.float64], glass: Lenses, view: int, pixel: NDArray[np.float64]) -> None:
    """Write the pixel (2,) of a point (3,) in the frame of the camera `view`."""
    depth = point[2] if abs(point[2]) >= NEAR else NEAR
    a, b = point[0] / depth, point[1] / depth
    squared = a * a + b * b
    k = glass.distortion[view]
    gain, _, _ = _radial(squared, k, glass.fisheye[view])
    x, y = gain * a, gain * b
    if not glass.fisheye[view]:
        x += 2 * k[2] * a * b + k[3] * (squared + 2 * a * a)
        y += k[2] * (squared + 2 * b * b) + 2 * k[3] * a * b
    pixel[0] = glass.focals[view, 0] * x + glass.centres[view, 0]
    pixel[1] = glass.focals[view, 1] * y + glass.centres[view, 1]


@compiled
def derive(
    point: NDArray[np.float64],
    glass: Lenses,
    view: int,
    pixel: NDArray[np.float64],
    by_point: NDArray[np.float64],
    by_optics: NDArray[np.float64],
) -> None:
    """Write the pixel (2,) and its derivatives.

    By the point, (2, 3), and by the log focal length, the principal point (x, y) and the first
    radial coefficient, (2, 4).
    """
    depth = point[2] if abs(point[2]) >= NEAR else NEAR
    a, b = point[0] / depth, point[1] / depth
    squared = a * a + b * b
    k = glass.distortion[view]
    gain, slope, by_first = _radial(squared, k, glass.fisheye[view])
    x, y = gain * a, gain * b
    # Bent by flat: gain 1 + 2 slope flat flat^T + the tangential part.
    xx, xy, yy = gain + 2 * slope * a * a, 2 * slope * a * b, gain + 2 * slope * b * b
    if not glass.fisheye[view]:
        p1, p2 = k[2], k[3]
        x += 2 * p1 * a * b + p2 * (squared + 2 * a * a)
        y += p1 * (squared + 2 * b * b) + 2 * p2 * a * b
        xx += 2 * p1 * b + 6 * p2 * a
        xy += 2 * (p1 * a + p2 * b)
        yy += 6 * p1 * b + 2 * p2 * a
    f, g = glass.focals[view, 0], glass.focals[view, 1]
    pixel[0], pixel[1] = f * x + glass.centres[view, 0], g * y + glass.centres[view, 1]
    # Flat by points: [1 0 -a; 0 1 -b] / z.
    by_point[0, 0], by_point[0, 1] = f * xx / depth, f * xy / depth
    by_point[0, 2] = -f * (xx * a + xy * b) / depth
    by_point[1, 0], by_point[1, 1] = g * xy / depth, g * yy / depth
    by_point[1, 2] = -g * (xy * a + yy * b) / depth
    by_optics[0, 0], by_optics[1, 0] = f * x, g * y
    by_optics[0, 1], by_optics[1, 1] = 1.0, 0.0
    by_optics[0, 2], by_optics[1, 2] = 0.0, 1.0
    by_optics[0, 3], by_optics[1, 3] = f * by_first * a, g * by_first * b


@inner
def _radial(squared: float, k: NDArray[np.float64], fisheye: bool) -> tuple[float, float, float]:
    """Radial gain L at a squared radius, dL / d squared, and dL / dk1."""
    if not fisheye:
        top = 1 + squared * (k[0] + squared * (k[1] + squared * k[4]))
        low = 1 + squared * (k[5] + squared * (k[6] + squared * k[7]))
        gain = top / low
        slope = (
            k[0]
            + squared * (2 * k[1] + 3 * squared * k[4])
            - gain * (k[5] + squared * (2 * k[6] + 3 * squared * k[7]))
        ) / low
        return gain, slope, squared / low
    radius = math.sqrt(max(squared, TINY))
    angle = math.atan(radius)
    a2 = angle * angle
    by_first = a2 * angle / radius
    if squared < TINY:
        return 1.0, k[0] - 1 / 3, by_first
    bent = angle * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    rate = 1 + a2 * (3 * k[0] + a2 * (5 * k[1] + a2 * (7 * k[2] + a2 * 9 * k[3])))
    gain = bent / radius
    return gain, (rate / (1 + squared) - gain) / (2 * squared), by_first
