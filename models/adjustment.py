"""Perspective maximum-a-posteriori adjustment: structures, cameras and the rig from keypoints.

Every frame has a structure X (P, 3) with a Gaussian shape prior, and every *group* of cameras has
a similarity per frame, `v = e^a R X + t`. Cameras that rest relative to each other form a group and
see it through extrinsics that all frames share, `x_cam = C v + d`; a camera that moves on its own
is a group of one, with C = 1 and d = 0. A rig at rest, moving cameras and any mixture of the two
are thus one problem, solved by Levenberg-Marquardt with analytic Jacobians. Points are eliminated
first (Schur complement), then each frame's poses and shape, so the cost is linear in frames and
points (Triggs et al., *Bundle Adjustment: A Modern Synthesis*, 2000; Hartley & Zisserman, *Multiple
View Geometry*, app. 6). Everything here is float64: N frames, K views, P keypoints, G groups.
"""

from collections.abc import Generator
from typing import NamedTuple

import torch
from torch import Tensor

from models.optics import Optics, image
from models.segments import Segments

POSE = SIMILARITY = 7  # rotation vector, translation, log size
OPTICS = 4  # log focal length, principal point, first radial coefficient
EXTRINSICS = 6  # rotation vector, translation
VIEW = OPTICS + EXTRINSICS  # what all frames share of a view
OUTLIER = 3.0  # noise standard deviations from which a keypoint pulls with constant force (Huber)
NEAREST = 1e-2  # depth, in units of the structure, behind which no camera sees
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
CONVERGED = 1e-7  # relative decrease of the cost


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

    def whitened(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Prior precision times (points - means), (N, P, 3); minus twice the log density, (N,).

        The last is the inverse variance (N,) of a unit of e.
        """
        offset = points - self.means
        pulled = torch.einsum("piq,npi->nq", self.basis, offset)
        z = torch.cholesky_solve(pulled.T, torch.linalg.cholesky(self.inner())).T
        inverse = 1 / (self.scales * self.spread).square()
        pull = (offset - torch.einsum("piq,nq->npi", self.basis, z)) * inverse[:, None, None]
        squared = (pull * offset).sum((1, 2))
        if not self.heavy:
            return pull, squared, inverse
        freedom = 3 * offset.shape[1] - SIMILARITY
        share = (freedom / squared.clamp_min(1e-12)).clamp_max(1)
        return (
            pull * share[:, None, None],
            freedom * (1 / share).log() + squared * share,
            (inverse * share),
        )

    def inner(self) -> Tensor:
        """B^T B + spread^2 1, (Q, Q)."""
        flat = self.basis.flatten(0, 1)
        return flat.T @ flat + self.spread**2 * torch.eye(flat.shape[1], dtype=flat.dtype)


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


class Normal(NamedTuple):
    """Normal equations of N frames; R = 7 G + Q unknowns remain beside the points, T are shared."""

    points: Tensor  # (N, P, 3, 3)
    coupling: Tensor  # (N, P, 3, R + T)
    rest: Tensor  # (N, R + T, R + T)
    pull_points: Tensor  # (N, P, 3) minus the gradient
    pull_rest: Tensor  # (N, R + T)


def place(scene: Scene, rig: Rig) -> tuple[Tensor, Tensor, Tensor]:
    """Points in every camera's frame (N, K, P, 3); e^a R X and v, both (N, K, P, 3)."""
    turned = scene.sizes.exp()[..., None, None] * (scene.points[:, None] @ scene.rotations.mT)
    turned = turned[:, rig.groups]
    v = turned + scene.translations[:, rig.groups, None]
    return v @ rig.rotations.mT + rig.translations[:, None], turned, v


def cost(views: Views, rig: Rig, prior: ShapePrior, size_precision: Tensor, scene: Scene) -> Tensor:
    """Minus twice the log posterior of each frame (N,), up to a constant."""
    camera, _, _ = place(scene, rig)
    pixels = image(camera, rig.optics)
    squared = views.weights * (pixels - views.keypoints).square().sum(-1)  # (N, K, P)
    robust = torch.where(
        squared > OUTLIER**2, 2 * OUTLIER * squared.clamp_min(1e-12).sqrt() - OUTLIER**2, squared
    )
    behind = ((camera[..., 2] < NEAREST) & (views.weights > 0)).any(-1).any(-1)
    total = robust.sum((1, 2)) + prior.whitened(scene.points)[1]
    total = total + (size_precision * scene.sizes.square()).sum(-1)
    return torch.where(behind | ~total.isfinite(), torch.inf, total)


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
    frames, count, _ = scene.points.shape
    camera, turned, v = place(scene, rig)
    pixels, by_camera, by_optics = image(camera, rig.optics, jacobians=True)
    residual = views.keypoints - pixels  # (N, K, P, 2)
    squared = views.weights * residual.square().sum(-1)
    weights = views.weights * (OUTLIER / squared.clamp_min(1e-12).sqrt()).clamp_max(1)

    by_v = by_camera @ rig.rotations[:, None]  # (N, K, P, 2, 3)
    growth = scene.sizes.exp()[..., None, None] * scene.rotations  # (N, G, 3, 3)
    by_points = by_v @ growth[:, rig.groups, None]  # (N, K, P, 2, 3)
    by_pose = torch.cat(
        (_turning(by_v, turned), by_v, by_v @ turned[..., None]), -1
    )  # (N, K, P, 2, 7)
    weighted = weights[..., None, None] * by_points
    points = (weighted.mT @ by_points).sum(1)  # (N, P, 3, 3)
    pull_points = (weighted.mT @ residual[..., None]).sum(1)[..., 0]
    groups, basis = rig.size, prior.basis.shape[-1]
    # One group's columns are the sums over its views.
    member = torch.nn.functional.one_hot(rig.groups, groups).to(residual)  # (K, G)
    coupling = torch.einsum("nkpic,kg->npigc", weighted.mT @ by_pose, member)
    weighted_pose = weights[..., None, None] * by_pose
    rows = weighted_pose.permute(0, 1, 4, 2, 3).flatten(-2)  # (N, K, 7, 2 P)
    pose = torch.einsum("nkab,kg->ngab", rows @ by_pose.flatten(2, 3), member)  # (N, G, 7, 7)
    pull_pose = torch.einsum("nka,kg->nga", (rows @ residual.flatten(2)[..., None])[..., 0], member)
    # The log sizes have a Gaussian prior about 0.
    pose[..., -1, -1] += size_precision
    pull_pose[..., -1] -= size_precision * scene.sizes

    pull, _, inverse = prior.whitened(scene.points)
    pull_points, inverse = pull_points - pull, inverse[:, None, None]
    points = points + inverse[..., None] * torch.eye(3, dtype=points.dtype)

    size = POSE * groups + basis
    total = size + (VIEW * len(rig.groups) if shared else 0)
    rest = points.new_zeros(frames, total, total)
    pull_rest = points.new_zeros(frames, total)
    cross = points.new_zeros(frames, count, 3, total)
    cross[..., : POSE * groups] = coupling.flatten(-2)
    cross[..., POSE * groups : size] = -inverse[..., None] * prior.basis
    for g in range(groups):
        block = slice(POSE * g, POSE * (g + 1))
        rest[:, block, block] = pose[:, g]
        pull_rest[:, block] = pull_pose[:, g]
    rest[:, POSE * groups : size, POSE * groups : size] = inverse * prior.inner()
    if shared:
        by_shared = torch.cat(
            (by_optics, _turning(by_camera, v @ rig.rotations.mT), by_camera), -1
        )  # (N, K, P, 2, 10)
        rows = (weights[..., None, None] * by_shared).permute(0, 1, 4, 2, 3).flatten(-2)
        own = rows @ by_shared.flatten(2, 3)  # (N, K, 10, 10)
        pull = (rows @ residual.flatten(2)[..., None])[..., 0]
        with_pose = rows @ by_pose.flatten(2, 3)  # (N, K, 10, 7)
        cross[..., size:] = (weighted.mT @ by_shared).permute(0, 2, 3, 1, 4).flatten(-2)
        for k, g in enumerate(rig.groups.tolist()):
            mine = slice(size + VIEW * k, size + VIEW * (k + 1))
            block = slice(POSE * g, POSE * (g + 1))
            rest[:, mine, mine] = own[:, k]
            pull_rest[:, mine] = pull[:, k]
            rest[:, mine, block] = with_pose[:, k]
            rest[:, block, mine] = with_pose[:, k].mT
    return Normal(points, cross, rest, pull_points, pull_rest)


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
    best = cost(views, rig, prior, size_precision, scene)
    damping = torch.full_like(best, FIRST_DAMPING)
    active = best.isfinite().nonzero()[:, 0]
    for _ in range(iterations):
        if not len(active):
            break
        part = Views(*(a[active] for a in views))
        here = Scene(*(a[active] for a in scene))
        local = prior.of(active)
        normal = normal_equations(part, rig, local, size_precision, here, shared=False)
        step = _solve(normal, damping[active])
        tried = move(here, *step, rig.size)
        costs = cost(part, rig, local, size_precision, tried)
        better = costs <= best[active]
        gained = (best[active] - costs) / best[active].clamp_min(1e-9)
        scene = Scene(
            *(
                old.index_copy(0, active[better], new[better])
                for old, new in zip(scene, tried, strict=True)
            )
        )
        best[active[better]] = costs[better]
        factor = torch.where(better, 0.1, 10.0)
        damping[active] = (damping[active] * factor).clamp(LEAST_DAMPING, MOST_DAMPING)
        done = (better & (gained < CONVERGED)) | (damping[active] >= MOST_DAMPING)
        active = active[~done]
    return scene, best


def _solve(normal: Normal, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Take one damped Gauss-Newton step: of the points (N, P, 3) and of the rest (N, R)."""
    points, reduced, pull = eliminate_points(normal, damping)
    factor, _ = torch.linalg.cholesky_ex(reduced)
    rest = torch.cholesky_solve(pull[..., None], factor)[..., 0]
    moved = normal.pull_points - (normal.coupling @ rest[:, None, :, None])[..., 0]
    return (points @ moved[..., None])[..., 0], rest


def eliminate_points(normal: Normal, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse point blocks (N, P, 3, 3), and the Schur complement with its right-hand side."""
    eye3 = torch.eye(3, dtype=normal.points.dtype)
    blocks = normal.points + damping[:, None, None, None] * normal.points * eye3
    inverse = torch.linalg.inv(blocks)
    rest = normal.rest
    diagonal = rest.diagonal(dim1=-2, dim2=-1)
    carried = inverse @ normal.coupling  # (N, P, 3, R)
    flat = normal.coupling.flatten(1, 2)  # (N, 3 P, R)
    reduced = rest - flat.mT @ carried.flatten(1, 2)
    reduced = reduced + torch.diag_embed(damping[:, None] * diagonal + 1e-12)
    pull = (
        normal.pull_rest
        - (carried.flatten(1, 2).mT @ normal.pull_points.flatten(1)[..., None])[..., 0]
    )
    return inverse, reduced, pull


class Reduced(NamedTuple):
    """What remains of N frames' normal equations for what they share, and their answer to it."""

    information: Tensor  # (N, T, T)
    gradient: Tensor  # (N, T) minus the gradient
    points: Tensor  # (N, P, 3) step of the points if nothing shared moves
    points_by_shared: Tensor  # (N, P, 3, T) and how it changes if it does
    rest: Tensor  # (N, R) likewise
    rest_by_shared: Tensor  # (N, R, T)


def eliminate_frames(normal: Normal, size: int, damping: Tensor) -> Reduced:
    """Eliminate points, then the other `size` = R unknowns of each frame."""
    inverse, reduced, pull = eliminate_points(normal, damping)
    factor, _ = torch.linalg.cholesky_ex(reduced[:, :size, :size])
    link = reduced[:, :size, size:]  # (N, R, T)
    solved = torch.cholesky_solve(torch.cat((link, pull[:, :size, None]), -1), factor)
    left, rest = solved[..., :-1], solved[..., -1]
    rest_coupling, shared_coupling = normal.coupling[..., :size], normal.coupling[..., size:]
    alone = normal.pull_points - (rest_coupling @ rest[:, None, :, None])[..., 0]
    return Reduced(
        reduced[:, size:, size:] - link.mT @ left,
        pull[:, size:] - (link.mT @ rest[..., None])[..., 0],
        (inverse @ alone[..., None])[..., 0],
        inverse @ (rest_coupling @ left[:, None] - shared_coupling),
        rest,
        -left,
    )


def structure_covariances(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, *, size_precision: Tensor
) -> Tensor:
    """Covariances (N, 3 P, 3 P) of the structures about their best values (Laplace)."""
    normal = normal_equations(views, rig, prior, size_precision, scene, shared=False)
    inverse, reduced, _ = eliminate_points(normal, torch.full_like(prior.scales, 1e-9))
    carried = (inverse @ normal.coupling).flatten(1, 2)  # (N, 3 P, R)
    factor, _ = torch.linalg.cholesky_ex(reduced)
    covariances = carried @ torch.cholesky_solve(carried.mT, factor)
    count = inverse.shape[1]
    blocks = covariances.view(-1, count, 3, count, 3)
    blocks.diagonal(dim1=1, dim2=3).add_(inverse.permute(0, 2, 3, 1))
    return covariances


def move(scene: Scene, points: Tensor, rest: Tensor, groups: int) -> Scene:
    """Apply steps of the points (N, P, 3) and of the rest (N, R) to a scene."""
    pose = rest[:, : POSE * groups].reshape(len(rest), groups, POSE)
    return Scene(
        scene.points + points,
        turn(pose[..., :3]) @ scene.rotations,
        scene.translations + pose[..., 3:6],
        scene.sizes + pose[..., 6].clamp(-1, 1),
    )


def _turning(by: Tensor, arms: Tensor) -> Tensor:
    """Derive by a rotation vector: by (..., 2, 3) times -[arms]_x, arms (..., 3)."""
    turned: Tensor = torch.linalg.cross(arms[..., None, :].expand_as(by), by, dim=-1)
    return turned


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

    Returns the rig, the scene, the cost per frame (N,) and the information (T, T): the inverse of
    the covariance of what is shared, frames marginalised. `segments` of the subject have a say in
    what is shared; frames follow as their keypoints and the shape prior have it.
    """
    costs = cost(views, rig, prior, size_precision, scene)
    kept = costs.isfinite()
    views = views._replace(weights=views.weights * kept[:, None, None])

    def total_cost(costs: Tensor, scene: Scene, rig: Rig) -> Tensor:
        total = costs[kept].sum() + shared.cost(rig)
        return total if segments is None else total + segments.cost(scene.points[kept]).sum()

    best = total_cost(costs, scene, rig)
    damping = FIRST_DAMPING
    information = shared.precision
    size = POSE * rig.size + prior.basis.shape[-1]
    for _ in range(iterations):
        yield
        normal = normal_equations(views, rig, prior, size_precision, scene, shared=True)
        damped = torch.full_like(costs, damping)
        reduced = eliminate_frames(normal, size, damped)
        information = reduced.information.sum(0) + shared.precision
        gradient = reduced.gradient.sum(0)
        gradient = gradient - shared.precision @ shared.offset(rig)
        if segments is not None:
            offsets = segments.offsets(scene.points + reduced.points)
            derived = segments.derivatives(scene.points, reduced.points_by_shared)
            weighted = (segments.precision(offsets) * kept[:, None])[..., None] * derived
            information = information + weighted.flatten(0, 1).T @ derived.flatten(0, 1)
            gradient = gradient - weighted.flatten(0, 1).T @ offsets.flatten()
        step = torch.zeros_like(gradient)
        free = shared.free
        inner = information[free][:, free]
        inner = inner + torch.diag(damping * inner.diagonal() + 1e-12)
        step[free] = torch.linalg.solve(inner, gradient[free])
        points = reduced.points + reduced.points_by_shared @ step
        rest = reduced.rest + reduced.rest_by_shared @ step
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
