"""Perspective maximum-a-posteriori adjustment: structures, cameras and the rig from keypoints.

Every frame has a structure X (P, 3) with a Gaussian shape prior, and every *group* of cameras has
a similarity per frame, `v = e^a R X + t`. Cameras that rest relative to each other form a group and
see it through extrinsics that all frames share, `x_cam = C v + d`; a camera that moves on its own
is a group of one, with C = 1 and d = 0. A rig at rest, moving cameras and any mixture of the two
are thus one problem, solved by Levenberg-Marquardt with analytic Jacobians. Points are eliminated
first (Schur complement), then each frame's poses and shape, so the cost is linear in frames and
points (Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Hartley & Zisserman, *Multiple
View Geometry*, app. 6). What concerns one frame is compiled, in `models.bundle.frame`. Everything
here is float64: N frames, K views, P keypoints, G groups.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.bone_lengths import Segments
from models.bundle.frame import (
    CONVERGED,
    FIRST_DAMPING,
    LEAST_DAMPING,
    MOST_DAMPING,
    OPTICS,
    POSE,
    VIEW,
    Cameras,
    Equations,
    Pose,
    Shapes,
    back_substitute,
    cost_of,
    descend,
    eliminate,
    linearise,
    make_equations,
)
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, cholesky_solve, copy
from models.numerics.threads import in_slices, room
from models.optics.lenses import Optics, lenses

Float64 = NDArray[np.float64]

SLICE = 16  # frames that a thread takes at a time


class Rig(NamedTuple):
    """What all frames share of K views."""

    optics: Optics
    groups: Tensor  # (K,) integers: the group of each view
    rotations: Tensor  # (K, 3, 3) C, group to camera
    translations: Tensor  # (K, 3) d, units of the structure

    @property
    def size(self) -> int:
        """The number of groups G."""
        return int(self.groups.max()) + 1

    def cameras(self, size_precision: Tensor) -> Cameras:
        """Lay out for compiled functions, with the inverse variances (G,) of the log sizes."""
        return Cameras(
            lenses(self.optics),
            np.ascontiguousarray(self.groups.numpy()),
            _array(self.rotations),
            _array(self.translations),
            _array(size_precision),
        )


class ShapePrior(NamedTuple):
    """About a mean per frame: x = mean + s (B z + e), z ~ N(0, 1), e ~ N(0, spread^2).

    With `heavy` tails the scale of a frame is s or, if its structure says so, more: the density is
    the profile of the Gaussian over all scales from s on.
    """

    means: Tensor  # (N, P, 3)
    basis: Tensor  # (P, 3, Q) columns scaled by their standard deviations
    spread: float
    scales: Tensor  # (N,) s
    heavy: bool = False

    def of(self, frames: Tensor | slice) -> "ShapePrior":
        """Return the prior of some of the frames."""
        return self._replace(means=self.means[frames], scales=self.scales[frames])

    def inner(self) -> Tensor:
        """B^T B + spread^2 1, (Q, Q)."""
        flat = self.basis.flatten(0, 1)
        return flat.T @ flat + self.spread**2 * torch.eye(flat.shape[1], dtype=flat.dtype)

    def shapes(self) -> Shapes:
        """Lay out what all frames share for compiled functions."""
        inner = self.inner()
        factor = torch.linalg.cholesky(inner)
        return Shapes(
            _array(self.basis.flatten(0, 1)),
            _array(inner),
            _array(factor),
            self.spread,
            self.heavy,
        )


class Views(NamedTuple):
    """What was seen, and how surely."""

    keypoints: Tensor  # (N, K, P, 2) pixels, any finite number where the weight is 0
    weights: Tensor  # (N, K, P) confidence over noise variance, 1 / pixels^2


class Scene(NamedTuple):
    """The unknowns of N frames."""

    points: Tensor  # (N, P, 3)
    rotations: Tensor  # (N, G, 3, 3)
    translations: Tensor  # (N, G, 3)
    sizes: Tensor  # (N, G) log size a

    def poses(self) -> Pose:
        """Lay out for compiled functions."""
        return Pose(*(_array(a) for a in self))


class Normal(NamedTuple):
    """Normal equations of N frames; R = 7 G + Q unknowns remain beside the points, T are shared."""

    points: Tensor  # (N, P, 3, 3)
    coupling: Tensor  # (N, P, 3, R + T)
    rest: Tensor  # (N, R + T, R + T)
    pull_points: Tensor  # (N, P, 3) minus the gradient
    pull_rest: Tensor  # (N, R + T)


class _Problem(NamedTuple):
    """N frames of a problem, laid out for compiled functions."""

    keypoints: Float64
    weights: Float64
    cameras: Cameras
    means: Float64
    scales: Float64
    shapes: Shapes


def _problem(views: Views, rig: Rig, prior: ShapePrior, size_precision: Tensor) -> _Problem:
    return _Problem(
        _array(views.keypoints),
        _array(views.weights),
        rig.cameras(size_precision),
        _array(prior.means),
        _array(prior.scales),
        prior.shapes(),
    )


def _array(tensor: Tensor) -> Float64:
    return np.ascontiguousarray(tensor.numpy(), np.float64)


def place(scene: Scene, rig: Rig) -> Tensor:
    """Points in every camera's frame (N, K, P, 3)."""
    turned = scene.sizes.exp()[..., None, None] * (scene.points[:, None] @ scene.rotations.mT)
    v = turned[:, rig.groups] + scene.translations[:, rig.groups, None]
    return v @ rig.rotations.mT + rig.translations[:, None]


def cost(views: Views, rig: Rig, prior: ShapePrior, size_precision: Tensor, scene: Scene) -> Tensor:
    """Minus twice the log posterior of each frame (N,), up to a constant."""
    problem, poses = _problem(views, rig, prior, size_precision), scene.poses()
    costs = room(len(scene.points))
    in_slices(len(costs), SLICE, lambda part: _costs(problem, poses, part.start, part.stop, costs))
    return torch.from_numpy(costs)


@compiled
def _costs(problem: _Problem, poses: Pose, start: int, stop: int, costs: Float64) -> None:
    for n in range(start, stop):
        costs[n] = cost_of(
            problem.keypoints[n],
            problem.weights[n],
            problem.cameras,
            problem.means[n],
            problem.scales[n],
            problem.shapes,
            _pose(poses, n),
        )


@inner
def _pose(poses: Pose, n: int) -> Pose:
    return Pose(poses.points[n], poses.rotations[n], poses.translations[n], poses.sizes[n])


def normal_equations(
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    size_precision: Tensor,
    scene: Scene,
    *,
    shared: bool,
) -> Normal:
    """Linearise; with `shared`, also in what all frames share (T = 10 K, otherwise T = 0)."""
    problem, poses = _problem(views, rig, prior, size_precision), scene.poses()
    frames, count, _ = scene.points.shape
    unknowns = POSE * rig.size + prior.basis.shape[-1] + (VIEW * len(rig.groups) if shared else 0)
    equations = Equations(
        room(frames, count, 3, 3),
        room(frames, count, 3, unknowns),
        room(frames, unknowns, unknowns),
        room(frames, count, 3),
        room(frames, unknowns),
    )
    in_slices(
        frames,
        SLICE,
        lambda part: _linearise(problem, poses, part.start, part.stop, equations),
    )
    return Normal(*(torch.from_numpy(a) for a in equations))


@compiled
def _linearise(problem: _Problem, poses: Pose, start: int, stop: int, out: Equations) -> None:
    for n in range(start, stop):
        linearise(
            problem.keypoints[n],
            problem.weights[n],
            problem.cameras,
            problem.means[n],
            problem.scales[n],
            problem.shapes,
            _pose(poses, n),
            _equations(out, n),
        )


@inner
def _equations(all_of_them: Equations, n: int) -> Equations:
    return Equations(
        all_of_them.points[n],
        all_of_them.coupling[n],
        all_of_them.rest[n],
        all_of_them.pull_points[n],
        all_of_them.pull_rest[n],
    )


def refine(
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    *,
    size_precision: Tensor,
    iterations: int = 20,
) -> tuple[Scene, Tensor]:
    """Adjust every frame on its own, the rig as it is; the scene and its costs (N,).

    `size_precision` (G,) is the inverse variance of each group's log size. A group of one view
    needs it: its size and its distance are one.
    """
    problem = _problem(views, rig, prior, size_precision)
    poses = Scene(*(a.clone(memory_format=torch.contiguous_format) for a in scene)).poses()
    costs = room(len(scene.points))
    in_slices(
        len(costs),
        SLICE,
        lambda part: _descend(problem, poses, part.start, part.stop, iterations, costs),
    )
    return Scene(*(torch.from_numpy(a) for a in poses)), torch.from_numpy(costs)


@compiled
def _descend(
    problem: _Problem, poses: Pose, start: int, stop: int, iterations: int, costs: Float64
) -> None:
    for n in range(start, stop):
        costs[n] = descend(
            problem.keypoints[n],
            problem.weights[n],
            problem.cameras,
            problem.means[n],
            problem.scales[n],
            problem.shapes,
            _pose(poses, n),
            iterations,
        )


class Reduced(NamedTuple):
    """What remains of N frames' normal equations for what they share, and their answer to it."""

    information: Float64  # (N, T, T)
    gradient: Float64  # (N, T) minus the gradient
    points: Float64  # (N, P, 3) step of the points if nothing shared moves
    points_by_shared: Float64  # (N, P, 3, T) and how it changes if it does
    rest: Float64  # (N, R) likewise
    rest_by_shared: Float64  # (N, R, T)


def eliminate_frames(normal: Normal, free: Tensor, damping: float) -> Reduced:
    """Eliminate points, then the other R unknowns of each frame; `free` (T,) of the shared stay."""
    equations = Equations(*(a.numpy() for a in normal))
    frames, count, _, unknowns = equations.coupling.shape
    size, shared = unknowns - len(free), int(free.sum())
    kept = np.concatenate((np.arange(size), size + np.flatnonzero(free.numpy())))
    reduced = Reduced(
        room(frames, shared, shared),
        room(frames, shared),
        room(frames, count, 3),
        room(frames, count, 3, shared),
        room(frames, size),
        room(frames, size, shared),
    )
    in_slices(
        frames,
        SLICE,
        lambda part: _eliminate(equations, kept, part.start, part.stop, damping, reduced),
    )
    return reduced


@inner
def _keep(source: Equations, kept: NDArray[np.int64], out: Equations) -> None:
    """Write the equations of some of the unknowns beside the points, as if others were zero."""
    copy(source.points, out.points)
    copy(source.pull_points, out.pull_points)
    for a in range(len(kept)):
        out.pull_rest[a] = source.pull_rest[kept[a]]
        for b in range(len(kept)):
            out.rest[a, b] = source.rest[kept[a], kept[b]]
        for p in range(len(source.points)):
            for i in range(3):
                out.coupling[p, i, a] = source.coupling[p, i, kept[a]]


@compiled
def _eliminate(
    equations: Equations,
    kept: NDArray[np.int64],
    start: int,
    stop: int,
    damping: float,
    out: Reduced,
) -> None:
    count, unknowns = equations.coupling.shape[1], len(kept)
    size, shared = out.rest_by_shared.shape[1], out.rest_by_shared.shape[2]
    own, inverses = make_equations(count, unknowns), np.empty((count, 3, 3))
    whole, pull = np.empty((unknowns, unknowns)), np.empty(unknowns)
    factor, answers = np.empty((size, size)), np.empty((shared + 1, size))
    right = np.empty((3, shared))
    for n in range(start, stop):
        _keep(_equations(equations, n), kept, own)
        eliminate(own, damping, inverses, whole, pull)
        for a in range(size):
            for b in range(a + 1):
                factor[a, b] = whole[a, b]
        cholesky(factor)
        for a in range(shared + 1):
            copy(whole[size + a, :size] if a < shared else pull[:size], answers[a])
            cholesky_solve(factor, answers[a])
        rest = answers[shared]
        copy(rest, out.rest[n])
        for a in range(shared):
            link = whole[size + a]
            out.gradient[n, a] = pull[size + a] - _dot(link, rest)
            for b in range(a + 1):
                out.information[n, a, b] = link[size + b] - _dot(link, answers[b])
                out.information[n, b, a] = out.information[n, a, b]
            for b in range(size):
                out.rest_by_shared[n, b, a] = -answers[a, b]
        back_substitute(own, inverses, rest, out.points[n])
        for p in range(count):
            for i in range(3):
                row = right[i]
                for a in range(shared):
                    row[a] = -own.coupling[p, i, size + a]
                for b in range(size):
                    pulls = own.coupling[p, i, b]
                    back = out.rest_by_shared[n, b]
                    for a in range(shared):
                        row[a] -= pulls * back[a]
            for i in range(3):
                x, y, z = inverses[p, i, 0], inverses[p, i, 1], inverses[p, i, 2]
                for a in range(shared):
                    out.points_by_shared[n, p, i, a] = (
                        x * right[0, a] + y * right[1, a] + z * right[2, a]
                    )


@inner
def _dot(a: Float64, b: Float64) -> float:
    """Sum the products of numbers, as many as `b` has."""
    total = 0.0
    for i in range(len(b)):
        total += a[i] * b[i]
    return total


def structure_covariances(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, *, size_precision: Tensor
) -> Tensor:
    """Covariances (N, 3 P, 3 P) of the structures about their best values (Laplace)."""
    normal = normal_equations(views, rig, prior, size_precision, scene, shared=False)
    equations = Equations(*(a.numpy() for a in normal))
    frames, count, _ = scene.points.shape
    covariances = room(frames, 3 * count, 3 * count)
    in_slices(
        frames, SLICE, lambda part: _covariances(equations, part.start, part.stop, covariances)
    )
    return torch.from_numpy(covariances)


@compiled
def _covariances(equations: Equations, start: int, stop: int, out: Float64) -> None:
    count, size = equations.coupling.shape[1], equations.coupling.shape[3]
    inverses, pull = np.empty((count, 3, 3)), np.empty(size)
    reduced, carried = np.empty((size, size)), np.empty((3 * count, size))
    for n in range(start, stop):
        own = _equations(equations, n)
        eliminate(own, LEAST_DAMPING, inverses, reduced, pull)
        cholesky(reduced)
        for p in range(count):
            for i in range(3):
                x, y, z = inverses[p, i]
                row = carried[3 * p + i]
                for a in range(size):
                    row[a] = (
                        x * own.coupling[p, 0, a]
                        + y * own.coupling[p, 1, a]
                        + z * own.coupling[p, 2, a]
                    )
                # L^-1 of it: the covariance is the product of these, and the inverse blocks.
                for a in range(size):
                    total = row[a]
                    for b in range(a):
                        total -= reduced[a, b] * row[b]
                    row[a] = total / reduced[a, a]
        for a in range(3 * count):
            for b in range(a + 1):
                out[n, a, b] = _dot(carried[a], carried[b])
                out[n, b, a] = out[n, a, b]
        for p in range(count):
            for i in range(3):
                for j in range(3):
                    out[n, 3 * p + i, 3 * p + j] += inverses[p, i, j]


def move(scene: Scene, points: Tensor, rest: Tensor, groups: int) -> Scene:
    """Apply steps of the points (N, P, 3) and of the rest (N, R) to a scene."""
    pose = rest[:, : POSE * groups].reshape(len(rest), groups, POSE)
    return Scene(
        scene.points + points,
        turn(pose[..., :3]) @ scene.rotations,
        scene.translations + pose[..., 3:6],
        scene.sizes + pose[..., 6].clamp(-1, 1),
    )


def turn(vectors: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) by angle and axis of vectors (..., 3): Rodrigues."""
    angle = vectors.square().sum(-1).clamp_min(1e-24).sqrt()[..., None, None]
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*x.shape, 3, 3)
    eye = torch.eye(3, dtype=vectors.dtype)
    square = (1 - angle.cos()) / angle.square() * cross @ cross
    rotations: Tensor = eye + angle.sin() / angle * cross + square
    return rotations


class SharedPrior(NamedTuple):
    """Gaussian on what all frames share, 10 numbers a view as in `VIEW`; T = 10 K."""

    reference: Rig  # the mean
    precision: Tensor  # (T, T)
    free: Tensor  # (T,) bool; the others stay as they are

    def offset(self, rig: Rig) -> Tensor:
        """Return the rig minus the mean, (T,); extrinsics to first order."""
        ours, mean = rig.optics, self.reference.optics
        turned = rig.rotations @ self.reference.rotations.mT
        skew = (turned - turned.mT) / 2
        return torch.cat(
            (
                (ours.focals / mean.focals).log().mean(-1, keepdim=True),
                ours.centres - mean.centres,
                (ours.distortion - mean.distortion)[:, :1],
                torch.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), -1),
                rig.translations - self.reference.translations,
            ),
            -1,
        ).flatten()

    def cost(self, rig: Rig) -> Tensor:
        """Minus twice the log density."""
        offset = self.offset(rig)
        return offset @ self.precision @ offset


def move_rig(rig: Rig, step: Tensor) -> Rig:
    """Apply a step (T,) to a rig."""
    step = step.reshape(-1, VIEW)
    optics = rig.optics
    distortion = optics.distortion.clone()
    distortion[:, 0] += step[:, 3]
    return rig._replace(
        optics=optics._replace(
            focals=optics.focals * step[:, :1].clamp(-0.5, 0.5).exp(),
            centres=optics.centres + step[:, 1:3],
            distortion=distortion,
        ),
        rotations=turn(step[:, OPTICS : OPTICS + 3]) @ rig.rotations,
        translations=rig.translations + step[:, OPTICS + 3 :],
    )


def adjust(
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    *,
    size_precision: Tensor,
    shared: SharedPrior,
    segments: Segments | None = None,
    iterations: int = 20,
) -> Generator[None, None, tuple[Rig, Scene, Tensor, Tensor]]:
    """Adjust frames and rig together, yielding after each iteration.

    Returns the rig, the scene, the cost per frame (N,) and the information (F, F): the inverse of
    the covariance of what is free of the shared, frames marginalised. `segments` of the subject
    have a say in what is shared; frames follow as their keypoints and the shape prior have it.
    """
    costs = cost(views, rig, prior, size_precision, scene)
    kept = costs.isfinite()
    views = views._replace(weights=views.weights * kept[:, None, None])

    def total_cost(costs: Tensor, scene: Scene, rig: Rig) -> Tensor:
        total = costs[kept].sum() + shared.cost(rig)
        return total if segments is None else total + segments.cost(scene.points[kept]).sum()

    best = total_cost(costs, scene, rig)
    damping, free = FIRST_DAMPING, shared.free
    information = shared.precision[free][:, free]
    for _ in range(iterations):
        yield
        normal = normal_equations(views, rig, prior, size_precision, scene, shared=True)
        reduced = eliminate_frames(normal, free, damping)
        by_shared = torch.from_numpy(reduced.points_by_shared)
        information = torch.from_numpy(reduced.information.sum(0)) + shared.precision[free][:, free]
        gradient = torch.from_numpy(reduced.gradient.sum(0))
        gradient = gradient - (shared.precision @ shared.offset(rig))[free]
        if segments is not None:
            offsets = segments.offsets(scene.points + torch.from_numpy(reduced.points))
            derived = segments.derivatives(scene.points, by_shared)
            weighted = (segments.precision(offsets) * kept[:, None])[..., None] * derived
            information = information + weighted.flatten(0, 1).T @ derived.flatten(0, 1)
            gradient = gradient - weighted.flatten(0, 1).T @ offsets.flatten()
        damped = information + torch.diag(damping * information.diagonal() + 1e-12)
        step = torch.zeros_like(free, dtype=torch.float64)
        step[free] = torch.linalg.solve(damped, gradient)
        points = torch.from_numpy(reduced.points) + by_shared @ step[free]
        rest = (
            torch.from_numpy(reduced.rest) + torch.from_numpy(reduced.rest_by_shared) @ step[free]
        )
        tried, tried_rig = move(scene, points, rest, rig.size), move_rig(rig, step)
        new_costs = cost(views, tried_rig, prior, size_precision, tried)
        total = total_cost(new_costs, tried, tried_rig)
        if total <= best:
            gained = (best - total) / best.clamp_min(1e-9)
            scene, rig, best, costs = tried, tried_rig, total, new_costs
            damping = max(damping / 10, LEAST_DAMPING)
            if gained < CONVERGED:
                break
        else:
            damping *= 10
            if damping > MOST_DAMPING:
                break
    return rig, scene, costs, information
