"""Perspective and fisheye lenses: pixels of points in a camera's frame, with analytic derivatives.

Pinhole lenses have OpenCV's distortion (k1, k2, p1, p2, k3, k4, k5, k6), fisheye lenses OpenCV's
(k1, k2, k3, k4): https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and group__calib3d__fisheye
"""

from typing import Literal, NamedTuple, overload

import torch
from torch import Tensor

COEFFICIENTS = 8
TINY = 1e-8  # squared radius below which a fisheye's series is used


class Optics(NamedTuple):
    """Lenses of K views."""

    focals: Tensor  # (K, 2) pixels, along x and y
    centres: Tensor  # (K, 2) principal points, pixels
    distortion: Tensor  # (K, 8) unitless, 0 where unused
    fisheye: Tensor  # (K,) bool


@overload
def image(points: Tensor, optics: Optics) -> Tensor: ...
@overload
def image(
    points: Tensor, optics: Optics, *, jacobians: Literal[True]
) -> tuple[Tensor, Tensor, Tensor]: ...
def image(
    points: Tensor, optics: Optics, *, jacobians: bool = False
) -> Tensor | tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, K, P, 2) of points (N, K, P, 3) in the cameras' frames (x right, y down, z ahead).

    With `jacobians` also their derivatives by the points, (N, K, P, 2, 3), and by the log focal
    length, the principal point (x, y) and the first radial coefficient, (N, K, P, 2, 4).
    """
    depth = points[..., 2:]
    safe = torch.where(depth.abs() < 1e-6, 1e-6, depth)
    flat = points[..., :2] / safe  # (N, K, P, 2)
    squared = flat.square().sum(-1)  # (N, K, P)
    k = optics.distortion[:, None].unbind(-1)  # 8 of (K, 1)
    gain, slope, by_first = _radial(squared, k, optics.fisheye[:, None])
    a, b = flat.unbind(-1)
    p1, p2 = (torch.where(optics.fisheye[:, None], 0, p) for p in k[2:4])
    skewed = torch.stack(
        (2 * p1 * a * b + p2 * (squared + 2 * a * a), p1 * (squared + 2 * b * b) + 2 * p2 * a * b),
        -1,
    )
    bent = gain[..., None] * flat + skewed
    focals = optics.focals[:, None]
    pixels = focals * bent + optics.centres[:, None]
    if not jacobians:
        return pixels
    # bent by flat: gain 1 + 2 slope flat flat^T + the tangential part.
    eye = torch.eye(2, dtype=points.dtype)
    bend = gain[..., None, None] * eye + 2 * slope[..., None, None] * (
        flat[..., :, None] * flat[..., None, :]
    )
    off = 2 * (p1 * a + p2 * b)
    bend = bend + torch.stack(
        (2 * p1 * b + 6 * p2 * a, off, off, 6 * p1 * b + 2 * p2 * a), -1
    ).reshape(*bend.shape)
    # flat by points: [1 0 -a; 0 1 -b] / z.
    by_points = torch.cat((bend, -(bend @ flat[..., None])), -1) / safe[..., None]
    by_points = focals[..., None] * by_points
    by_optics = torch.stack(
        (
            focals * bent,
            torch.tensor([1.0, 0.0], dtype=points.dtype).expand_as(bent),
            torch.tensor([0.0, 1.0], dtype=points.dtype).expand_as(bent),
            focals * by_first[..., None] * flat,
        ),
        -1,
    )
    return pixels, by_points, by_optics


def _radial(squared: Tensor, k: tuple[Tensor, ...], fisheye: Tensor) -> tuple[Tensor, ...]:
    """Radial gain L at squared radii, dL / d squared, and dL / dk1."""
    top = 1 + squared * (k[0] + squared * (k[1] + squared * k[4]))
    low = 1 + squared * (k[5] + squared * (k[6] + squared * k[7]))
    gain = top / low
    slope = (
        k[0]
        + squared * (2 * k[1] + 3 * squared * k[4])
        - gain * (k[5] + squared * (2 * k[6] + 3 * squared * k[7]))
    ) / low
    by_first = squared / low
    if not fisheye.any():
        return gain, slope, by_first
    radius = squared.clamp_min(TINY).sqrt()
    angle = radius.atan()
    a2 = angle.square()
    bent = angle * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    rate = 1 + a2 * (3 * k[0] + a2 * (5 * k[1] + a2 * (7 * k[2] + a2 * 9 * k[3])))
    fish = bent / radius
    fish_slope = (rate / (1 + radius.square()) - fish) / (2 * radius.square())
    near = squared < TINY
    fish = torch.where(near, 1.0, fish)
    fish_slope = torch.where(near, k[0] - 1 / 3, fish_slope)
    return (
        torch.where(fisheye, fish, gain),
        torch.where(fisheye, fish_slope, slope),
        torch.where(fisheye, a2 * angle / radius, by_first),
    )
