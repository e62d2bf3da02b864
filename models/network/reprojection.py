"""Geometry of a training step, compiled, with its gradients.

What `models.optics.weak_perspective` says in many small tensor operations, forwards and backwards,
is one call here; tests hold the two against each other. Arrays are torch's on the CPU; elsewhere
the operations of `models.optics.weak_perspective` do the work.
"""

from typing import Any

import torch
from torch import Tensor

from models.network import reprojection_gradients, reprojection_kernels
from models.optics.weak_perspective import TINY, nearest_rotation, project, solve_cameras


def reproject(
    points: Tensor, turns: Tensor, keypoints: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Normalise structures, solve the cameras that see `keypoints`, and project.

    Parameters
    ----------
    points
        (N, P, 3) structures of any size and place.
    turns
        (N, K, 2, 3) matrices whose nearest rotations are the guesses of `solve_cameras`.
    keypoints, weights
        (N, K, P, 2) and (N, K, P); they get no gradient.

    Returns
    -------
    tuple
        Structures (N, P, 3), centred, root-mean-square radius 1, and their projections
        (N, K, P, 2); 0 in views without weight.
    """
    if points.device.type == "cpu":
        points, projected = _Reprojection.apply(points, turns, keypoints, weights)  # type: ignore[no-untyped-call]
        return points, projected
    return plain_reprojection(points, turns, keypoints, weights)


def plain_reprojection(
    points: Tensor, turns: Tensor, keypoints: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Do what `reproject` does in tensor operations, on any device."""
    points = normalise(points)
    guesses, _ = nearest_rotation(turns)
    cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
    return points, project(points[:, None], cameras)


def fill(projected: Tensor, keypoints: Tensor, weights: Tensor) -> Tensor:
    """Put reprojections (N, K, P, 2) where keypoints are hidden, and normalise the views anew."""
    if projected.device.type == "cpu":
        filled: Tensor = _Filling.apply(projected, keypoints, weights)  # type: ignore[no-untyped-call]
        return filled
    seen = weights[..., None]
    return normalise(seen * keypoints + (1 - seen) * projected)


def normalise(points: Tensor) -> Tensor:
    """Centre points (..., P, D) and bring them to root-mean-square radius 1."""
    points = points - points.mean(-2, keepdim=True)
    radius = points.square().sum(-1).mean(-1).clamp_min(TINY).sqrt()
    return points / radius[..., None, None]


class _Reprojection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, turns: Tensor, keypoints: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        # Other layouts would be compiled anew.
        points, turns, keypoints, weights = (
            part.contiguous() for part in (points, turns, keypoints, weights)
        )
        normal, projected = torch.empty_like(points), torch.empty_like(keypoints)
        ctx.saved = (points, normal, turns, keypoints, weights)
        reprojection_kernels.reproject(*(part.detach().numpy() for part in (*ctx.saved, projected)))
        return normal, projected

    @staticmethod
    def backward(ctx: Any, by_points: Tensor, by_projected: Tensor) -> tuple[Tensor | None, ...]:
        points, _, turns, _, _ = ctx.saved
        gradients = torch.empty_like(points), torch.empty_like(turns)
        given = (*ctx.saved, by_points.contiguous(), by_projected.contiguous(), *gradients)
        reprojection_gradients.reproject_back(*(part.detach().numpy() for part in given))
        return *gradients, None, None


class _Filling(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, projected: Tensor, keypoints: Tensor, weights: Tensor) -> Tensor:
        keypoints, weights = keypoints.contiguous(), weights.contiguous()
        filled, sizes = torch.empty_like(keypoints), torch.empty_like(weights[..., 0])
        given = (projected, keypoints, weights, filled, sizes)
        reprojection_kernels.fill(*(part.detach().numpy() for part in given))
        ctx.saved = (weights, filled, sizes)
        return filled

    @staticmethod
    def backward(ctx: Any, by_filled: Tensor) -> tuple[Tensor | None, ...]:
        gradient = torch.empty_like(by_filled)
        given = (*ctx.saved, by_filled.contiguous(), gradient)
        reprojection_gradients.fill_back(*(part.detach().numpy() for part in given))
        return gradient, None, None
