"""Geometry of a training step in tensor operations, differentiable, for other devices than the CPU.

On the CPU the same is compiled: `reprojection_kernels` with `models.optics.weak_perspective`, whose
docstrings explain what is computed and why. Tests compare each function here with its compiled
twin, values and gradients. The functions are also exported to ONNX (`models.lifting.onnx_file`),
whose tracer does not support every operation: not `mT`, `diagonal` or `torch.linalg.solve`.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from models.numerics.normalisation import LEAST_MEAN_SQUARE
from models.numerics.rotations import PARALLEL, ZERO_LENGTH
from models.numerics.tensor_systems import solve_symmetric
from models.numerics.tiny import TINY
from models.optics.weak_perspective import RIDGE


class WeakPerspective(NamedTuple):
    """Cameras of any batch shape (...)."""

    rotations: Tensor  # (..., 3, 3) det +1
    scales: Tensor  # (...) image units per unit of the structure
    translations: Tensor  # (..., 2) image units


def reproject_tensors(
    points: Tensor, matrices: Tensor, keypoints: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the same as `models.network.reprojection.reproject`, on any device."""
    points = normalise(points)
    cameras = solve_cameras(points[:, None], keypoints, weights, nearest_rotations(matrices))
    return points, project(points[:, None], cameras)


def fill_tensors(projected: Tensor, keypoints: Tensor, weights: Tensor) -> Tensor:
    """Compute the same as `models.network.reprojection.fill`, on any device."""
    seen = weights[..., None]
    return normalise(seen * keypoints + (1 - seen) * projected)


def normalise(points: Tensor) -> Tensor:
    """Centre points (..., P, D) and bring them to root-mean-square radius 1."""
    points = points - points.mean(-2, keepdim=True)
    radius = points.square().sum(-1).mean(-1).clamp_min(LEAST_MEAN_SQUARE).sqrt()
    return points / radius[..., None, None]


def project(points: Tensor, cameras: WeakPerspective) -> Tensor:
    """Project points (..., P, 3) to the image (..., P, 2): w = s (R X)_xy + t, paper eq. 1."""
    xy = points @ cameras.rotations[..., :2, :].transpose(-1, -2)
    return cameras.scales[..., None, None] * xy + cameras.translations[..., None, :]


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Rotations (..., 3, 3) whose first two rows are nearest to `matrices` (..., 2, 3).

    Twin of `models.numerics.rotations.nearest_orthonormal_rows_into`. Computed in float64: in
    float32, rows that are nearly parallel have no digits left.
    """
    rows = matrices.double()
    first, second = rows.unbind(-2)  # (..., 3) each
    a, c = first.square().sum(-1, keepdim=True), second.square().sum(-1, keepdim=True)
    b = (first * second).sum(-1, keepdim=True)
    normal = torch.linalg.cross(first, second, dim=-1)
    squared = normal.square().sum(-1, keepdim=True)
    parallel = (squared.detach().sqrt() <= PARALLEL * (a + c)) | (a + c <= TINY)
    det = torch.where(parallel, 1.0, squared).sqrt()
    trace = (torch.where(parallel, 1.0, a + c) + 2 * det).sqrt()
    x = ((c + det) * first - b * second) / (trace * det)
    y = ((a + det) * second - b * first) / (trace * det)
    nearest = torch.stack((x, y, normal / det), -2)
    if torch.onnx.is_in_onnx_export() or parallel.any():
        nearest = torch.where(parallel[..., None], _nearest_to_parallel(rows.detach()), nearest)
    return nearest.to(matrices.dtype)


def _nearest_to_parallel(rows: Tensor) -> Tensor:
    """Nearest rotations (..., 3, 3) of parallel rows (..., 2, 3); they have no gradient."""
    lengths = rows.square().sum(-1)  # (..., 2)
    length = lengths.sum(-1, keepdim=True).sqrt()  # (..., 1)
    longer = lengths.argmax(-1)[..., None, None].expand(*rows.shape[:-2], 1, 3)
    v = torch.nn.functional.normalize(rows.gather(-2, longer)[..., 0, :], dim=-1)
    cos, sin = (rows @ v[..., None] / length.clamp_min(ZERO_LENGTH)[..., None]).unbind(-2)
    # w: the cross product of v with the axis that v is farthest from.
    axis = torch.nn.functional.one_hot(v.abs().argmin(-1), 3).to(v)
    w = torch.nn.functional.normalize(torch.linalg.cross(axis, v, dim=-1), dim=-1)
    x, y = cos * v - sin * w, sin * v + cos * w
    nearest = torch.stack((x, y, torch.linalg.cross(x, y, dim=-1)), -2)
    eye = torch.eye(3, dtype=rows.dtype, device=rows.device)
    return torch.where(length[..., None] <= ZERO_LENGTH, eye, nearest)


def solve_cameras(
    points: Tensor, image: Tensor, weights: Tensor, guesses: Tensor
) -> WeakPerspective:
    """Cameras that project `points` onto `image` with least weighted squared error.

    Twin of `models.optics.weak_perspective.solve_camera_into`, which explains the solution.

    Parameters
    ----------
    points, image
        (..., P, 3) structures and (..., P, 2) keypoints, any finite number where the weight is 0.
    weights
        (..., P) of at least 0; a view without any gets scale 0 and translation 0.
    guesses
        (..., 3, 3) rotations.
    """
    share = (weights / weights.sum(-1, keepdim=True).clamp_min(TINY))[..., None]  # (..., P, 1)
    points_mean = (share * points).sum(-2)  # (..., 3)
    image_mean = (share * image).sum(-2)  # (..., 2)
    points, image = points - points_mean[..., None, :], image - image_mean[..., None, :]
    weighted_image = share * image  # (..., P, 2)

    scatter = (share * points).transpose(-1, -2) @ points  # (..., 3, 3)
    cross = points.transpose(-1, -2) @ weighted_image  # (..., 3, 2)
    variance = (share * points.square()).sum((-2, -1))[..., None, None] + TINY
    spread = (weighted_image * image).sum((-2, -1))[..., None, None]
    ridge = RIDGE * variance
    pull = ridge * (spread / variance + TINY).sqrt()
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    pulled = cross + pull * guesses[..., :2, :].transpose(-1, -2)
    affine = solve_symmetric(scatter + ridge * eye, pulled)
    rotations = nearest_rotations(affine.transpose(-1, -2))

    axes = rotations[..., :2, :].transpose(-1, -2)  # (..., 3, 2)
    # Sums over the points are products with their scatter: |X axes|^2 = axes^T scatter axes.
    scales = (cross * axes).sum((-2, -1)) / (((scatter @ axes) * axes).sum((-2, -1)) + TINY)
    offset = (points_mean[..., None, :] @ axes)[..., 0, :]
    return WeakPerspective(rotations, scales, image_mean - scales[..., None] * offset)
