"""Weak-perspective cameras: projection, and the closed-form orthographic-n-point solution.

Conventions: a camera takes `x_cam = R X + t` with R in SO(3) and axes x right, y down, z forward;
weak perspective projects it to `w = s (R X)_xy + t_xy`. Everything here is differentiable and
works on any leading batch dimensions.
"""

from typing import NamedTuple

import torch
from torch import Tensor

RIDGE = 1e-4  # share of the structure's variance: above float32 noise, below any real depth
TINY = 1e-12
NOTHING = 1e-9  # turns the undefined direction of (0, 0) into no turn


class WeakPerspective(NamedTuple):
    """Cameras of any batch shape (...)."""

    rotations: Tensor  # (..., 3, 3) det +1
    scales: Tensor  # (...) image units per unit of the structure
    translations: Tensor  # (..., 2) image units


def project(points: Tensor, cameras: WeakPerspective) -> Tensor:
    """Project points (..., P, 3) to the image (..., P, 2): w = s (R X)_xy + t, paper eq. 1."""
    xy = points @ cameras.rotations[..., :2, :].mT
    return cameras.scales[..., None, None] * xy + cameras.translations[..., None, :]


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation whose first two rows are nearest to `matrix` (..., 2, 3), and the stretch.

    The nearest pair of orthonormal rows is U V^T of the singular value decomposition (Higham,
    *Functions of Matrices*, ch. 8), found here without one: Gram-Schmidt leaves a triangle
    [[a, 0], [b, d]] with a, d >= 0, whose 2x2 polar factor turns by atan2(b, a + d). So gradients
    stay finite where singular values coincide. The third row is the cross product (det +1).

    Returns rotations (..., 3, 3) and the mean singular value (...). Where the rows are parallel
    or zero the nearest rotation is not unique; one of them is returned.
    """
    first, second = matrix.unbind(-2)  # (..., 3) each
    x, a = _unit(first, first)
    b = (x * second).sum(-1, keepdim=True)
    y, d = _unit(second - b * x, x)
    y = y - (x * y).sum(-1, keepdim=True) * x  # once more: digits were lost if d << b

    cos, sin = a + d + NOTHING, b
    stretch = (cos.square() + sin.square()).sqrt()
    cos, sin = cos / stretch, sin / stretch
    top, middle = cos * x - sin * y, sin * x + cos * y
    rotations = torch.stack((top, middle, torch.linalg.cross(top, middle, dim=-1)), -2)
    return rotations, stretch[..., 0] / 2


def _unit(vectors: Tensor, away_from: Tensor) -> tuple[Tensor, Tensor]:
    """Split (..., 3) into unit vectors and lengths (..., 1).

    A zero gets some direction at a right angle to the unit vector `away_from`.
    """
    squared = vectors.square().sum(-1, keepdim=True)
    zero = squared <= TINY
    if not zero.any():
        lengths = squared.sqrt()
        return vectors / lengths, lengths
    lengths = torch.where(zero, 1.0, squared).sqrt()
    axis = torch.nn.functional.one_hot(away_from.abs().argmin(-1), 3).to(vectors)
    axis = axis - (axis * away_from).sum(-1, keepdim=True) * away_from
    axis = torch.nn.functional.normalize(axis.detach(), dim=-1)
    return torch.where(zero, axis, vectors / lengths), torch.where(zero, 0.0, lengths)


def solve_cameras(points: Tensor, image: Tensor, weights: Tensor, guess: Tensor) -> WeakPerspective:
    """Cameras that project `points` onto `image` with least weighted squared error, closed form.

    The orthographic-n-point problem with scale (paper, "Calculating R using solution from OnP"):
    solve the linear least squares w = M X for the 2x3 matrix M, take the nearest rotation, then
    the best scale and translation for it. Alone, the linear step inverts the 3x3 scatter of the
    points and blows up on a flat structure; a ridge towards `guess` keeps the turn about what the
    points leave open where the guess had it.

    Parameters
    ----------
    points
        (..., P, 3) structures.
    image
        (..., P, 2) keypoints, any finite number where the weight is 0.
    weights
        (..., P) non-negative; a view without any gets the guess, scale 0 and translation 0.
    guess
        (..., 3, 3) rotations.
    """
    share = (weights / weights.sum(-1, keepdim=True).clamp_min(TINY))[..., None]  # (..., P, 1)
    points_mean = (share * points).sum(-2)  # (..., 3)
    image_mean = (share * image).sum(-2)  # (..., 2)
    points, image = points - points_mean[..., None, :], image - image_mean[..., None, :]
    weighted_image = share * image  # (..., P, 2)

    scatter = (share * points).mT @ points  # (..., 3, 3)
    cross = points.mT @ weighted_image  # (..., 3, 2)
    variance = scatter.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + TINY
    spread = (weighted_image * image).sum((-2, -1))[..., None, None]
    ridge = RIDGE * variance
    # A typical scale is enough for the guess: it only speaks where the points do not.
    pull = ridge * (spread / variance + TINY).sqrt()
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    affine = torch.linalg.solve(scatter + ridge * eye, cross + pull * guess[..., :2, :].mT)
    rotations, _ = nearest_rotation(affine.mT)

    axes = rotations[..., :2, :].mT  # (..., 3, 2)
    # Sums over the points are products with their scatter: |X axes|^2 = axes^T scatter axes.
    scales = (cross * axes).sum((-2, -1)) / (((scatter @ axes) * axes).sum((-2, -1)) + TINY)
    offset = (points_mean[..., None, :] @ axes)[..., 0, :]
    return WeakPerspective(rotations, scales, image_mean - scales[..., None] * offset)
