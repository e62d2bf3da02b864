"""The loss of a training step: reprojection errors, and distances to teachers."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.numerics.compiled import compiled, inner
from models.numerics.rotations import nearest_rotation_into

Floats = NDArray[Any]  # of 32 or 64 bits

STRUCTURE = 3.0  # weight of the distance to the teachers next to the reprojection error
SOFT = 1e-8  # keeps the gradient of a root finite where a view or a teacher is met exactly
LEAST_WEIGHT = 1e-6  # of a view: less would divide by zero


class Batch(NamedTuple):
    """The B frames of one step."""

    keypoints: Tensor  # (B, K, P, 2) normalised
    weights: Tensor  # (B, K, P)
    sizes: Tensor  # (B, K) pixels; 0 in virtual frames, whose reprojection is not reported
    factors: Tensor  # (B,) weight of a frame's reprojection error
    teachers: Tensor  # (B, P, 3) structures to come near to
    taught: Tensor  # (B,) 1 where there is such a structure, else 0

    def to(self, device: torch.device) -> "Batch":
        """Return the batch on a device."""
        return self if device.type == "cpu" else Batch(*(part.to(device) for part in self))


def objective(points: Tensor, projected: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return the loss of a batch's structures (B, P, 3) and projections (B, K, P, 2).

    Returns
    -------
    tuple
        The total, differentiable, and two figures: paper eq. "final_loss", the mean over views of
        the reprojection error, as a weighted root mean square so that views with gaps count the
        same; and the mean reprojection error in pixels, of the frames that are the capture's.
    """
    if points.device.type == "cpu":
        total, figures = _Objective.apply(points, projected, *batch)  # type: ignore[no-untyped-call]
        return total, figures
    return plain_objective(points, projected, batch)


def plain_objective(points: Tensor, projected: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Compute the same as `objective` in tensor operations, on any device."""
    squared = (projected - batch.keypoints).square().sum(-1)
    weight = batch.weights.sum(-1)  # (B, K)
    mean = (batch.weights * squared).sum(-1) / weight.clamp_min(LEAST_WEIGHT)
    there = (weight > 0).to(squared.dtype)
    norms = there * (mean + SOFT).sqrt()
    views = there.sum().clamp_min(1)
    total = (batch.factors[:, None] * norms).sum() / views
    own = batch.taught / batch.taught.sum().clamp_min(1)
    total = total + STRUCTURE * (own * _structure_distances(points, batch.teachers)).sum()
    shown = (batch.weights > 0) & (batch.sizes > 0)[..., None]
    pixels = (
        squared.detach().sqrt() * batch.sizes[..., None] * shown
    ).sum() / shown.sum().clamp_min(1)
    return total, torch.stack((norms.detach().sum() / views, pixels))


def _structure_distances(points: Tensor, teachers: Tensor) -> Tensor:
    """Root-mean-square distances (N,) of structures (N, P, 3) from `teachers`, rotated onto them.

    By Kabsch's rotation, which needs no gradient: at the optimum the distance does not change with
    it.
    """
    with torch.no_grad():
        u, _, vt = torch.linalg.svd(teachers.mT @ points)
        u[..., -1] *= (torch.linalg.det(u) * torch.linalg.det(vt)).sign()[:, None]
        teachers = teachers @ (u @ vt)
    return ((points - teachers).square().sum(-1).mean(-1) + SOFT).sqrt()


class _Loss(NamedTuple):
    """What `objective` returns, as numbers."""

    total: float
    loss: float
    pixels: float


class _ViewError(NamedTuple):
    """The reprojection error of a view, and the distances of the keypoints that it shows."""

    error: float  # weighted root mean square
    distances: float  # their sum
    shown: int  # their number


class _Objective(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, projected: Tensor, *batch: Tensor
    ) -> tuple[Tensor, Tensor]:
        by_points, by_projected = torch.empty_like(points), torch.empty_like(projected)
        given = (points, projected, *batch, by_points, by_projected)
        result = _objective(*(part.detach().numpy() for part in given))
        ctx.gradients = (by_points, by_projected)
        figures = torch.tensor((result.loss, result.pixels), dtype=torch.float64)
        ctx.mark_non_differentiable(figures)
        return points.new_tensor(result.total), figures

    @staticmethod
    def backward(ctx: Any, by_total: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        by_points, by_projected = ctx.gradients
        return by_points * by_total, by_projected * by_total, *(None for _ in Batch._fields)


@compiled
def _objective(
    points: Floats,
    projected: Floats,
    keypoints: Floats,
    weights: Floats,
    sizes: Floats,
    factors: Floats,
    teachers: Floats,
    taught: Floats,
    by_points: Floats,
    by_projected: Floats,
) -> _Loss:
    """Compute `objective`; write the gradients (B, P, 3) and (B, K, P, 2) of the total.

    The arguments from `keypoints` to `taught` are the parts of a `Batch`.
    """
    frames, views = weights.shape[:2]
    total = loss = pixels = 0.0
    seen_views = shown = students = 0
    for n in range(frames):
        students += 1 if taught[n] > 0 else 0
        for k in range(views):
            seen_views += 1 if weights[n, k].any() else 0
    seen_views = max(seen_views, 1)
    rotation = np.empty((3, 3))
    for n in range(frames):
        for k in range(views):
            view = _view_error(
                projected[n, k],
                keypoints[n, k],
                weights[n, k],
                factors[n] / seen_views,
                by_projected[n, k],
            )
            loss += view.error / seen_views
            total += factors[n] * view.error / seen_views
            if sizes[n, k] > 0:
                pixels += sizes[n, k] * view.distances
                shown += view.shown
        if taught[n] > 0:
            factor = STRUCTURE / students
            distance = _structure_distance(points[n], teachers[n], factor, rotation, by_points[n])
            total += STRUCTURE * distance / students
        else:
            by_points[n] = 0
    return _Loss(total, loss, pixels / max(shown, 1))


@inner
def _view_error(
    projected: Floats, keypoints: Floats, weights: Floats, factor: float, by_projected: Floats
) -> _ViewError:
    """Return the error of one view (P, 2); write the gradient (P, 2) of `factor` times it."""
    weight = squares = distances = 0.0
    shown = 0
    for p in range(len(weights)):
        x, y = projected[p, 0] - keypoints[p, 0], projected[p, 1] - keypoints[p, 1]
        square = x * x + y * y
        weight += weights[p]
        squares += weights[p] * square
        if weights[p] > 0:
            distances += math.sqrt(square)
            shown += 1
    if shown == 0:
        by_projected[:] = 0
        return _ViewError(0.0, 0.0, 0)
    weight = max(weight, LEAST_WEIGHT)
    error = math.sqrt(squares / weight + SOFT)
    pull = factor / (weight * error)
    for p in range(len(weights)):
        for d in range(2):
            by_projected[p, d] = pull * weights[p] * (projected[p, d] - keypoints[p, d])
    return _ViewError(error, distances, shown)


@inner
def _structure_distance(
    points: Floats, teacher: Floats, factor: float, rotation: Floats, by_points: Floats
) -> float:
    """Return the root-mean-square distance of a structure (P, 3) from its teacher (P, 3).

    The teacher is rotated onto the structure first; `rotation` (3, 3) is a buffer. Writes the
    gradient (P, 3) of `factor` times the distance.
    """
    count = len(points)
    _rotation_onto(teacher, points, rotation)
    squares = 0.0
    for p in range(count):
        x, y, z = teacher[p, 0], teacher[p, 1], teacher[p, 2]
        for d in range(3):
            off = points[p, d] - rotation[d, 0] * x - rotation[d, 1] * y - rotation[d, 2] * z
            by_points[p, d] = off
            squares += off * off
    distance = math.sqrt(squares / count + SOFT)
    for p in range(count):
        for d in range(3):
            by_points[p, d] *= factor / (count * distance)
    return distance


@inner
def _rotation_onto(points: Floats, others: Floats, rotation: Floats) -> None:
    """Write the rotation (3, 3) that brings points (P, 3) nearest to others (P, 3)."""
    cross = np.zeros((3, 3))
    for p in range(len(points)):
        for i in range(3):
            for j in range(3):
                cross[i, j] += float(others[p, i]) * points[p, j]
    nearest_rotation_into(cross, rotation)
