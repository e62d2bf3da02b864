"""Geometry of a training step, differentiable: on the CPU compiled, elsewhere in tensor operations.

Compiled, a step is one call forwards and one backwards instead of many small operations.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.network import reprojection_gradients, reprojection_kernels
from models.network.reprojection_tensors import fill_tensors, reproject_tensors


def reproject(
    points: Tensor, matrices: Tensor, keypoints: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Normalise structures, solve the cameras that see `keypoints`, and project.

    Parameters
    ----------
    points
        (N, P, 3) structures of any size and place.
    matrices
        (N, K, 2, 3) matrices whose nearest rotations are the guesses of the camera solution.
    keypoints, weights
        (N, K, P, 2) and (N, K, P); they get no gradient.

    Returns
    -------
    tuple
        Structures (N, P, 3), centred, root-mean-square radius 1, and their projections
        (N, K, P, 2); 0 in views without weight.
    """
    if points.device.type == "cpu":
        points, projected = _Reprojection.apply(points, matrices, keypoints, weights)  # type: ignore[no-untyped-call]
        return points, projected
    return reproject_tensors(points, matrices, keypoints, weights)


def fill(projected: Tensor, keypoints: Tensor, weights: Tensor) -> Tensor:
    """Replace hidden keypoints by their reprojections, and normalise the views anew.

    Takes projections (N, K, P, 2), keypoints (N, K, P, 2) and weights (N, K, P), of which a share
    below 1 is filled; returns views (N, K, P, 2), centred, root-mean-square radius 1.
    """
    if projected.device.type == "cpu":
        filled: Tensor = _Filling.apply(projected, keypoints, weights)  # type: ignore[no-untyped-call]
        return filled
    return fill_tensors(projected, keypoints, weights)


class _Reprojection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, matrices: Tensor, keypoints: Tensor, weights: Tensor
    ) -> tuple[Tensor, ...]:
        given = _arrays(points, matrices, keypoints, weights)
        normal, projected = np.empty_like(given[0]), np.empty_like(given[2])
        ctx.known = (given[0], normal, *given[1:])
        passed = *ctx.known, projected
        reprojection_kernels.reproject(*passed)
        return _tensors(normal, projected)

    @staticmethod
    def backward(ctx: Any, by_points: Tensor, by_projected: Tensor) -> tuple[Tensor | None, ...]:
        points, _, matrices, _, _ = ctx.known
        gradients = np.empty_like(points), np.empty_like(matrices)
        given = *ctx.known, *_arrays(by_points, by_projected), *gradients
        reprojection_gradients.reproject_back(*given)
        return *_tensors(*gradients), None, None


class _Filling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, projected: Tensor, keypoints: Tensor, weights: Tensor) -> Tensor:
        seen = _arrays(projected, keypoints, weights)
        filled, sizes = np.empty_like(seen[1]), np.empty_like(seen[2][..., 0], order="C")
        ctx.known = (seen[2], filled, sizes)
        given = *seen, filled, sizes
        reprojection_kernels.fill(*given)
        return _tensors(filled)[0]

    @staticmethod
    def backward(ctx: Any, by_filled: Tensor) -> tuple[Tensor | None, ...]:
        _, filled, _ = ctx.known
        gradient = np.empty_like(filled)
        given = *ctx.known, *_arrays(by_filled), gradient
        reprojection_gradients.fill_back(*given)
        return *_tensors(gradient), None, None


def _arrays(*tensors: Tensor) -> tuple[NDArray[Any], ...]:
    """Return what tensors hold, in the one layout that functions are compiled for.

    A result that a function keeps as a tensor would keep the function, so neither would be freed.
    """
    return tuple(part.detach().contiguous().numpy() for part in tensors)


def _tensors(*arrays: NDArray[Any]) -> tuple[Tensor, ...]:
    return tuple(map(torch.from_numpy, arrays))
