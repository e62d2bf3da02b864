"""What a training step minimises: reprojection errors, and distances to teachers."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.compiled import compiled

Floats = NDArray[Any]  # of 32 or 64 bits

STRUCTURE = 3.0  # weight of the distance to the teachers next to the reprojection error
SOFT = 1e-8  # keeps the gradient of a root finite where a view or a teacher is met exactly
LEAST_WEIGHT = 1e-6
SQUARINGS = 20  # of a 4x4 matrix, after which its largest eigenvalue stands alone


class Batch(NamedTuple):
    """What one step sees, B frames."""

    keypoints: Tensor  # (B, K, P, 2) normalised
    weights: Tensor  # (B, K, P)
    sizes: Tensor  # (B, K) pixels; 0 in virtual frames, whose reprojection is not reported
    factors: Tensor  # (B,) weight of a frame's reprojection error
    teachers: Tensor  # (B, P, 3) structures to come near to
    taught: Tensor  # (B,) 1 where there is such a structure, else 0


def objective(points: Tensor, projected: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Sum up what a batch's structures (B, P, 3) and projections (B, K, P, 2) cost.

    Returns
    -------
    tuple
        The total, differentiable, and two figures: paper eq. "final_loss", the mean over views of
        the reprojection error, as a weighted root mean square so that views with gaps count the
        same; and the mean reprojection error in pixels of what frames of the capture show.
    """
    if points.device.type == "cpu":
        total, figures = _Objective.apply(points, projected, *batch)  # type: ignore[no-untyped-call]
        return total, figures
    return _plain(points, projected, batch)


def _plain(points: Tensor, projected: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    squared = (projected - batch.keypoints).square().sum(-1)
    weight = batch.weights.sum(-1)  # (B, K)
    mean = (batch.weights * squared).sum(-1) / weight.clamp_min(LEAST_WEIGHT)
    there = (weight > 0).to(squared.dtype)
    norms = there * (mean + SOFT).sqrt()
    views = there.sum().clamp_min(1)
    total = (batch.factors[:, None] * norms).sum() / views
    own = batch.taught / batch.taught.sum().clamp_min(1)
    total = total + STRUCTURE * (own * structure_distances(points, batch.teachers)).sum()
    shown = (batch.weights > 0) & (batch.sizes > 0)[..., None]
    pixels = (squared.detach().sqrt() * batch.sizes[..., None] * shown).sum() / shown.sum()
    return total, torch.stack((norms.detach().sum() / views, pixels))


def structure_distances(points: Tensor, teachers: Tensor) -> Tensor:
    """Root-mean-square distances (N,) of (N, P, 3) from `teachers` after turning these (Kabsch).

    The best turn needs no gradient: at the optimum the distance does not change with it.
    """
    with torch.no_grad():
        u, _, vt = torch.linalg.svd(teachers.mT @ points)
        u[..., -1] *= (torch.linalg.det(u) * torch.linalg.det(vt)).sign()[:, None]
        teachers = teachers @ (u @ vt)
    return ((points - teachers).square().sum(-1).mean(-1) + SOFT).sqrt()


class _Objective(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, projected: Tensor, *batch: Tensor
    ) -> tuple[Tensor, Tensor]:
        by_points, by_projected = torch.empty_like(points), torch.empty_like(projected)
        given = (points, projected, *batch, by_points, by_projected)
        total, loss, pixels = _objective(*(part.detach().numpy() for part in given))
        ctx.gradients = (by_points, by_projected)
        figures = torch.tensor((loss, pixels), dtype=torch.float64)
        ctx.mark_non_differentiable(figures)
        return points.new_tensor(total), figures

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
) -> tuple[float, float, float]:
    frames, views = weights.shape[:2]
    total = loss = pixels = 0.0
    there = shown = students = 0
    for n in range(frames):
        students += 1 if taught[n] > 0 else 0
        for k in range(views):
            there += 1 if weights[n, k].any() else 0
    there = max(there, 1)
    turn = np.empty((3, 3))
    for n in range(frames):
        for k in range(views):
            norm, distances, seen = _norm(
                projected[n, k],
                keypoints[n, k],
                weights[n, k],
                factors[n] / there,
                by_projected[n, k],
            )
            loss += norm / there
            total += factors[n] * norm / there
            if sizes[n, k] > 0:
                pixels += sizes[n, k] * distances
                shown += seen
        if taught[n] > 0:
            distance = _distance(points[n], teachers[n], STRUCTURE / students, turn, by_points[n])
            total += STRUCTURE * distance / students
        else:
            by_points[n] = 0
    return total, loss, pixels / max(shown, 1)


@compiled
def _norm(
    projected: Floats, keypoints: Floats, weights: Floats, factor: float, gradient: Floats
) -> tuple[float, float, int]:
    """Error of one view, the sum of distances of keypoints shown, and their number.

    The gradient is that of `factor` times the error.
    """
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
        gradient[:] = 0
        return 0.0, 0.0, 0
    weight = max(weight, LEAST_WEIGHT)
    norm = math.sqrt(squares / weight + SOFT)
    pull = factor / (weight * norm)
    for p in range(len(weights)):
        for d in range(2):
            gradient[p, d] = pull * weights[p] * (projected[p, d] - keypoints[p, d])
    return norm, distances, shown


@compiled
def _distance(
    points: Floats, teacher: Floats, factor: float, turn: Floats, gradient: Floats
) -> float:
    """Root-mean-square distance to the teacher; the gradient is that of `factor` times it."""
    count = len(points)
    _turn_onto(teacher, points, turn)
    squares = 0.0
    for p in range(count):
        x, y, z = teacher[p, 0], teacher[p, 1], teacher[p, 2]
        for d in range(3):
            off = points[p, d] - turn[d, 0] * x - turn[d, 1] * y - turn[d, 2] * z
            gradient[p, d] = off
            squares += off * off
    distance = math.sqrt(squares / count + SOFT)
    for p in range(count):
        for d in range(3):
            gradient[p, d] *= factor / (count * distance)
    return distance


@compiled
def _turn_onto(points: Floats, others: Floats, out: Floats) -> None:  # noqa: PLR0912
    """Find the rotation that brings points (P, 3) nearest to others.

    Horn, *Closed-form solution of absolute orientation using unit quaternions*, 1987: the
    quaternion is the eigenvector of the largest eigenvalue of a 4x4 matrix. Squared often enough,
    that matrix is a multiple of the eigenvector's outer product with itself.
    """
    s = np.zeros((3, 3))
    for p in range(len(points)):
        for i in range(3):
            for j in range(3):
                s[i, j] += float(points[p, i]) * others[p, j]
    m, square = np.empty((4, 4)), np.empty((4, 4))
    m[0, 0], m[0, 1] = s[0, 0] + s[1, 1] + s[2, 2], s[1, 2] - s[2, 1]
    m[0, 2], m[0, 3] = s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]
    m[1, 1], m[1, 2] = s[0, 0] - s[1, 1] - s[2, 2], s[0, 1] + s[1, 0]
    m[1, 3], m[2, 2] = s[2, 0] + s[0, 2], s[1, 1] - s[0, 0] - s[2, 2]
    m[2, 3], m[3, 3] = s[1, 2] + s[2, 1], s[2, 2] - s[0, 0] - s[1, 1]
    size = 0.0
    for i in range(4):
        for j in range(4):
            m[i, j] = m[min(i, j), max(i, j)]
            size += m[i, j] ** 2
    size = math.sqrt(size) + 1e-30
    for i in range(4):
        m[i, i] += size  # no eigenvalue is below zero any more
    for _ in range(SQUARINGS):
        trace = 1.0 / (m[0, 0] + m[1, 1] + m[2, 2] + m[3, 3])
        for i in range(4):
            for j in range(4):
                m[i, j] *= trace
        for i in range(4):
            for j in range(4):
                square[i, j] = (
                    m[i, 0] * m[0, j] + m[i, 1] * m[1, j] + m[i, 2] * m[2, j] + m[i, 3] * m[3, j]
                )
        m, square = square, m
    largest = 0
    for i in range(4):
        if m[i, i] > m[largest, largest]:
            largest = i
    length = 0.0
    for i in range(4):
        length += m[largest, i] ** 2
    length = 1.0 / math.sqrt(length)
    w, x, y, z = (
        length * m[largest, 0],
        length * m[largest, 1],
        length * m[largest, 2],
        length * m[largest, 3],
    )
    out[0, 0], out[0, 1], out[0, 2] = (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )
