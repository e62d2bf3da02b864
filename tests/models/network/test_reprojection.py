"""The compiled geometry of a training step against differentiable tensor operations."""

import gc
import weakref
from collections.abc import Callable

import numpy as np
import pytest
import torch

from models.network.losses import STRUCTURE, Batch, objective, plain_objective
from models.network.priors.hierarchical import HierarchicalPrior
from models.network.reprojection import fill, reproject
from models.network.reprojection_tensors import (
    fill_tensors,
    nearest_rotations,
    normalise,
    reproject_tensors,
)
from models.training import teachers as distillation
from models.training.virtual_views import drop_views, virtual_views

Tensor = torch.Tensor


def _drawn(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _weights(frames: int, views: int, keypoints: int) -> Tensor:
    """Confidences, with a hidden keypoint here and there, a view that is gone, and a whole one."""
    weights = _drawn(frames, views, keypoints, seed=9).sigmoid()
    weights[:, :, 0] = 0
    weights[0, 0] = 0
    weights[0, 1] = 1
    return weights


Reprojection = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


@pytest.mark.parametrize("shape", ["solid", "flat", "line"])
def test_reprojections_and_their_gradients_are_those_of_the_tensor_operations(shape: str) -> None:
    points, matrices = _drawn(3, 9, 3, seed=0), _drawn(3, 4, 2, 3, seed=1)
    if shape != "solid":
        points[..., {"flat": slice(2, 3), "line": slice(1, 3)}[shape]] *= 1e-3
    keypoints, weights = _drawn(3, 4, 9, 2, seed=2), _weights(3, 4, 9)
    upstream = _drawn(3, 9, 3, seed=3), _drawn(3, 4, 9, 2, seed=4)

    def run(how: Reprojection) -> list[Tensor]:
        given = points.clone().requires_grad_(), matrices.clone().requires_grad_()
        answers = how(*given, keypoints, weights)
        return [*answers, *torch.autograd.grad(answers, given, upstream)]

    for found, expected in zip(run(reproject), run(reproject_tensors), strict=True):
        scale = expected.detach().abs().max().item()
        torch.testing.assert_close(found, expected, atol=1e-5 * scale, rtol=0)


def test_what_a_training_step_computed_is_freed_with_its_last_use() -> None:
    keypoints, weights = _drawn(4, 3, 9, 2, seed=0).float(), _weights(4, 3, 9).float()
    prior = HierarchicalPrior(9, (16, 8))
    prior.initialise(0)
    batch = Batch(
        keypoints,
        weights,
        torch.ones(4, 3),
        torch.ones(4),
        _drawn(4, 9, 3, seed=1).float(),
        torch.ones(4),
    )

    def step() -> list[weakref.ref[Tensor]]:
        points, projected, matrices = prior.reproject(keypoints, weights)
        total, figures = objective(points, projected, batch)
        torch.autograd.backward(total)
        return [weakref.ref(each) for each in (points, projected, matrices, total, figures)]

    collecting = gc.isenabled()
    gc.disable()  # a circle would wait for it, and memory grow with each step until then
    try:
        assert [each() for each in step()] == 5 * [None]
    finally:
        if collecting:
            gc.enable()


def test_the_layout_of_tensors_does_not_matter() -> None:
    points, matrices = _drawn(3, 9, 3, seed=0), _drawn(3, 4, 2, 3, seed=1)
    keypoints, weights = _drawn(3, 4, 9, 2, seed=2), _weights(3, 4, 9)

    def turned(tensor: Tensor) -> Tensor:
        return tensor.mT.contiguous().mT

    usual = reproject(points, matrices, keypoints, weights)
    other = reproject(*map(turned, (points, matrices, keypoints, weights)))
    for ours, theirs in zip(usual, other, strict=True):
        torch.testing.assert_close(ours, theirs, atol=0, rtol=0)
    torch.testing.assert_close(
        fill(*map(turned, (usual[1], keypoints, weights))),
        fill(usual[1], keypoints, weights),
        atol=0,
        rtol=0,
    )


def test_rows_without_one_nearest_rotation_are_those_of_the_tensor_operations() -> None:
    """They lie in parallel, or are zero; no gradient goes through them."""
    matrices = _drawn(5, 1, 2, 3, seed=1)
    matrices[0] = 0
    matrices[1, 0, 1] = -2 * matrices[1, 0, 0]
    matrices[2, 0, 0] = 0
    matrices[3, 0] = torch.tensor([[0.0, 0, 1], [0, 0, 1]])
    keypoints, weights = _drawn(5, 1, 9, 2, seed=2), torch.ones(5, 1, 9).double()
    upstream = _drawn(5, 9, 3, seed=3), _drawn(5, 1, 9, 2, seed=4)

    def run(how: Reprojection) -> list[Tensor]:
        given = _drawn(5, 9, 3, seed=0).requires_grad_(), matrices.clone().requires_grad_()
        answers = how(*given, keypoints, weights)
        return [*answers, *torch.autograd.grad(answers, given, upstream)]

    found = run(reproject)
    for ours, theirs in zip(found, run(reproject_tensors), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=1e-7)
    assert (found[3][:4] == 0).all()
    assert (found[3][4] != 0).all()


def test_keypoints_in_a_line_are_those_of_the_tensor_operations() -> None:
    """The rows of the affine solution are parallel then, if the guess is."""
    keypoints = _drawn(2, 1, 9, 1, seed=2) * torch.tensor([1.0, -2.0]).double()
    matrices = torch.zeros(2, 1, 2, 3).double()
    matrices[..., 0, 0], matrices[..., 1, 0] = 1, -2
    points, weights = _drawn(2, 9, 3, seed=0), torch.ones(2, 1, 9).double()

    def run(how: Reprojection) -> list[Tensor]:
        given = points.clone().requires_grad_(), matrices
        answers = how(*given, keypoints, weights)
        return [*answers, *torch.autograd.grad(answers[1].square().sum(), given[:1])]

    for ours, theirs in zip(run(reproject), run(reproject_tensors), strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-7, rtol=1e-5)


def test_filling_is_that_of_the_tensor_operations_and_differentiable() -> None:
    projected, keypoints = _drawn(2, 3, 7, 2, seed=0).requires_grad_(), _drawn(2, 3, 7, 2, seed=1)
    weights = _weights(2, 3, 7)
    filled = fill(projected, keypoints, weights)
    torch.testing.assert_close(
        filled, fill_tensors(projected, keypoints, weights), atol=1e-9, rtol=0
    )
    torch.testing.assert_close(filled.mean(-2), torch.zeros(2, 3, 2).double(), atol=1e-9, rtol=0)
    assert torch.autograd.gradcheck(fill, (projected, keypoints, weights))


def _batch(frames: int, views: int, keypoints: int) -> Batch:
    taught = torch.tensor([1, 0, 1, 1, 0], dtype=torch.float64)[:frames]
    return Batch(
        keypoints=_drawn(frames, views, keypoints, 2, seed=5),
        weights=_weights(frames, views, keypoints),
        sizes=100 * _drawn(frames, views, seed=6).abs() * (1 - taught[:, None]),
        factors=_drawn(frames, seed=7).sigmoid(),
        teachers=_drawn(frames, keypoints, 3, seed=8),
        taught=taught,
    )


def test_the_objective_is_as_documented_and_its_gradient_is_right() -> None:
    batch = _batch(4, 3, 8)
    points = (batch.teachers + 0.4 * _drawn(4, 8, 3, seed=1)).requires_grad_()
    projected = _drawn(4, 3, 8, 2, seed=2).requires_grad_()
    total, figures = objective(points, projected, batch)

    squared = (projected - batch.keypoints).square().sum(-1)
    there = batch.weights.sum(-1) > 0
    mean = (batch.weights * squared).sum(-1)[there] / batch.weights.sum(-1)[there]
    norms, factors = mean.sqrt(), batch.factors[:, None].expand(4, 3)[there]
    own = points[batch.taught > 0].detach().numpy()
    teachers = batch.teachers[batch.taught > 0].numpy()
    u, _, vt = np.linalg.svd(own.transpose(0, 2, 1) @ teachers)
    u[:, :, -1] *= np.linalg.det(u @ vt)[:, None]
    off = own - teachers @ (u @ vt).transpose(0, 2, 1)
    structure = np.sqrt(np.square(off).sum(-1).mean(-1)).mean()
    assert total.item() == pytest.approx((factors * norms).mean().item() + STRUCTURE * structure)
    shown = (batch.weights > 0) & (batch.sizes > 0)[..., None]
    pixels = (squared.sqrt() * batch.sizes[..., None])[shown].mean()
    assert figures.tolist() == pytest.approx([norms.mean().item(), pixels.item()])
    plain, plain_figures = plain_objective(points, projected, batch)
    torch.testing.assert_close(plain, total)
    torch.testing.assert_close(plain_figures, figures)
    given = points, projected
    for found, expected in zip(
        torch.autograd.grad(total, given), torch.autograd.grad(plain, given), strict=True
    ):
        torch.testing.assert_close(found, expected)
    assert torch.autograd.gradcheck(
        lambda points, projected: objective(points, projected, batch)[0], given
    )


def test_a_teacher_may_be_rotated_but_not_mirrored() -> None:
    batch = _batch(4, 3, 8)
    rotations = nearest_rotations(_drawn(4, 2, 3, seed=1))
    projected = batch.keypoints
    rotated, _ = objective(batch.teachers @ rotations, projected, batch)
    mirrored, _ = objective(
        batch.teachers * torch.tensor([1.0, 1.0, -1.0]).double(), projected, batch
    )
    assert rotated < 1e-3
    assert mirrored > 0.1


def test_a_network_reads_every_frame_as_if_it_were_alone() -> None:
    network = HierarchicalPrior(9, (16, 8))
    network.initialise(0)
    keypoints, weights = _drawn(5, 3, 9, 2, seed=1).float(), _weights(5, 3, 9).float()
    weights[2] = 1
    keypoints = normalise(keypoints) * (weights > 0)[..., None]
    points, projected, matrices = network.reproject(keypoints, weights)
    for n in range(5):
        alone = network.reproject(keypoints[n : n + 1], weights[n : n + 1])
        for found, expected in zip(alone, (points[n], projected[n], matrices[n]), strict=True):
            torch.testing.assert_close(found[0], expected, atol=1e-5, rtol=1e-4)


def test_virtual_cameras_look_as_those_of_the_capture_do() -> None:
    """They stand upright, at any azimuth, and see the teacher in perspective."""
    points = normalise(_drawn(1, 40, 3, seed=0)).float()
    level = torch.tensor([[[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]])  # y down, z up in the structure
    teachers = distillation.as_teachers(
        points, level[None].expand(1, 2, 3, 3), torch.ones(1, 2), torch.tensor([0]), 1, 0.1, 0.0
    )
    weights = torch.ones(1, 2, 40)
    rng = np.random.default_rng(0)
    structures, views, shown = virtual_views(teachers, weights, 300, rng)
    torch.testing.assert_close(structures, points.expand(300, 40, 3))
    there = shown.sum(-1) > 0
    heights = -points[0, :, 2]
    flat = views[there]
    correlation = ((flat[..., 1] * heights).sum(-1) / flat[..., 1].norm(dim=-1)) / heights.norm()
    assert correlation.median() > 0.95  # up stays up, save for tilt and perspective
    azimuths = torch.atan2(flat[:, 0, 0], flat[:, 1, 0])
    assert azimuths.std() > 1  # while the sides change
    assert 0.4 < there.float().mean() < 0.95


def test_dropping_views_keeps_one_and_leaves_half_of_the_frames() -> None:
    weights = _weights(5, 3, 7).float().repeat(80, 1, 1)
    kept = drop_views(weights, np.random.default_rng(1))
    there, still = weights.sum(-1) > 0, kept.sum(-1) > 0
    assert still.any(1).all()
    torch.testing.assert_close(kept, weights * still[..., None])
    whole = (there == still).all(1).float().mean()
    assert 0.6 < whole < 0.8  # half, and those that drew all their views
