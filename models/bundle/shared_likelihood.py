"""The likelihood of the numbers that all frames share, at an optimum, and its curvature.

The log likelihood about the optimum is a parabola in the F free numbers, with each frame at its own
optimum. Three things make it less sharp than the normal equations of `adjustment`. Nothing is
damped here. The shape model and the bone lengths were learnt from the same keypoints and follow the
shared numbers, too (the missing information of EM: Louis, *Finding the observed information matrix
when using the EM algorithm*, 1982). And errors of a detector are correlated in all keypoints of a
frame and in all frames of a keypoint (Cameron, Gelbach & Miller, *Robust inference with multiway
clustering*, 2011).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import move_rig, move_scene
from models.bundle.bone_lengths import BoneLengths
from models.bundle.elimination import Reduced, eliminate_frames
from models.bundle.frame import LEAST_DAMPING
from models.bundle.frame_equations import OUTLIER
from models.bundle.problem import POSE, Rig, Scene, ShapePrior, Views, points_in_cameras
from models.bundle.separate_frames import normal_equations
from models.bundle.shape_model import similarity_directions
from models.optics.lenses.projection import project

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

STEP = 1e-5  # of a shared number, for differences of pixels


class SharedLikelihood(NamedTuple):
    """A parabola in F shared numbers about their present values."""

    score: Float64  # (F,) its slope
    curvature: Float64  # (F, F) with shape model and bone lengths fixed
    learnt: Float64  # (F, F) the part of it that is lost because these are learnt
    clustered: Float64  # (F, F) covariance of the score, from the scatter of its parts
    growth: Float64  # (G, F) derivative of the mean log size in each group

    @property
    def information(self) -> Float64:
        """Inverse covariance (F, F) of the shared numbers from keypoints alone."""
        return self.curvature - self.learnt


def likelihood_of_shared(
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    *,
    free: Bool,
    bones: BoneLengths | None = None,
    by_keypoint: bool = True,
) -> SharedLikelihood:
    """Return the likelihood of the `free` (T,) shared numbers; F of them.

    The prior must be a learnt shape model, the same for all frames. Without `by_keypoint` errors
    count as correlated within frames only, which takes less time.
    """
    equations = normal_equations(views, rig, prior, scene, shared=True)
    reduced = eliminate_frames(equations, free, LEAST_DAMPING)
    learnt = _learnt_shapes(reduced, prior, scene)
    scores, curvature = reduced.right, reduced.information.sum(0)  # (N, F)
    parts = [_scores_of_keypoints(views, rig, scene, reduced, free)] if by_keypoint else []
    if bones is not None:
        of_bones = _OfBones.at(bones, scene, reduced)
        curvature = curvature + of_bones.curvature
        learnt = learnt + of_bones.learnt
        scores = scores + of_bones.scores.sum(1)
        parts += [of_bones.scores] if by_keypoint else []
    clustered = scores.T @ scores
    for part in parts:  # (N, P or E, F)
        flat, by_cluster = part.reshape(-1, part.shape[-1]), part.sum(0)
        clustered = clustered + by_cluster.T @ by_cluster - flat.T @ flat
    growth = _growth(reduced, scene)
    return SharedLikelihood(scores.sum(0), curvature, learnt, clustered, growth)


def _growth(reduced: Reduced, scene: Scene) -> Float64:
    """Return the derivative (G, F) of the mean log size in each group by the shared numbers."""
    centred = scene.points - scene.points.mean(1, keepdims=True)  # (N, P, 3)
    along = centred / np.square(centred).sum((1, 2), keepdims=True)
    structures = np.einsum("npi,npif->f", along, reduced.points_by_shared) / len(along)
    groups = scene.sizes.shape[1]
    sizes = reduced.others_by_shared[:, POSE - 1 : POSE * groups : POSE].mean(0)  # (G, F)
    growth: Float64 = structures + sizes
    return growth


def _learnt_shapes(reduced: Reduced, prior: ShapePrior, scene: Scene) -> Float64:
    """Return the information (F, F) lost because mean and covariance of the shapes are learnt.

    With structures x and their derivatives x' by a shared number, the scatter S changes by
    S' = mean (x x'^T + x' x^T), and a Gaussian that follows it loses N/2 tr(S^-1 S' S^-1 S').
    """
    frames, count, _ = scene.points.shape
    size = 3 * count
    away = similarity_directions(prior.means[0])  # (3 P, 7)
    moved = reduced.points_by_shared.reshape(frames, size, -1)  # (N, 3 P, F)
    moved = moved - away @ (away.T @ moved)
    offsets = (scene.points - prior.means).reshape(frames, size)
    offsets = offsets - (offsets @ away) @ away.T
    mean = moved.mean(0)  # (3 P, F)
    offsets, moved = offsets - offsets.mean(0), moved - mean
    root = _whitening(prior)  # (3 P, 3 P)
    mean, offsets = root @ mean, offsets @ root.T
    moved = root @ moved
    half = np.einsum("na,nbf->fab", offsets, moved, optimize=True) / frames  # (F, 3 P, 3 P)
    changes = half + half.mT
    axes = np.linalg.qr(root @ prior.basis)[0] if prior.basis.shape[1] else prior.basis  # (3 P, Q)
    along = axes.T @ changes  # (F, Q, 3 P)
    within = along @ axes  # (F, Q, Q)
    # The model follows changes of its components, and the size of the isotropic part.
    others = (changes.trace(axis1=1, axis2=2) - within.trace(axis1=1, axis2=2))[:, None]
    beside = max(size - away.shape[1] - axes.shape[1], 1)
    flat_along, flat_within = (a.reshape(len(a), -1) for a in (along, within))
    products = 2 * flat_along @ flat_along.T - flat_within @ flat_within.T
    lost: Float64 = frames * (mean.T @ mean + (products + others @ others.T / beside) / 2)
    return lost


def _whitening(prior: ShapePrior) -> Float64:
    """Return the symmetric root (3 P, 3 P) of the prior's inverse covariance."""
    covariance = prior.basis @ prior.basis.T + prior.spread**2 * np.eye(len(prior.basis))
    values, vectors = np.linalg.eigh(covariance)
    root: Float64 = (vectors / np.sqrt(values)) @ vectors.T / prior.scale
    return root


def _scores_of_keypoints(
    views: Views, rig: Rig, scene: Scene, reduced: Reduced, free: Bool
) -> Float64:
    """Parts (N, P, F) of the score that come from each keypoint of a frame."""
    residuals = views.keypoints - project(points_in_cameras(scene, rig), rig.lenses)
    pull = views.weights * np.square(residuals).sum(-1)  # (N, K, P)
    robust = views.weights * (OUTLIER / np.sqrt(pull.clip(1e-12))).clip(max=1)
    weighted = robust[..., None] * np.where(views.weights[..., None] > 0, residuals, 0)
    scores = np.empty((*scene.points.shape[:2], int(free.sum())))
    for number, place in enumerate(np.flatnonzero(free)):
        step = np.zeros(len(free))
        sides = []
        for sign in (STEP, -STEP):
            step[place] = sign
            moved = move_scene(
                scene,
                sign * reduced.points_by_shared[..., number],
                sign * reduced.others_by_shared[..., number],
            )
            other = move_rig(rig, step)
            sides.append(project(points_in_cameras(moved, other), other.lenses))
        derived = (sides[0] - sides[1]) / (2 * STEP)  # (N, K, P, 2)
        scores[..., number] = (weighted * derived).sum((1, 3))
    return scores


class _OfBones(NamedTuple):
    """The terms of bone lengths in `SharedLikelihood`."""

    scores: Float64  # (N, E, F)
    curvature: Float64  # (F, F)
    learnt: Float64  # (F, F)

    @classmethod
    def at(cls, bones: BoneLengths, scene: Scene, reduced: Reduced) -> "_OfBones":
        """Linearise the lengths; their means and scatters follow the shared numbers."""
        offsets = bones.offsets(scene.points)  # (N, E)
        derived = bones.derivatives(scene.points, reduced.points_by_shared)  # (N, E, F)
        weights = bones.precision(offsets)[..., None]
        scores = -weights * offsets[..., None] * derived
        whole = weights.sum(0).clip(1e-12)  # (E, 1)
        means = (weights * derived).sum(0) / whole  # (E, F)
        rows = derived.reshape(-1, derived.shape[-1])
        curvature = rows.T @ (weights.reshape(-1, 1) * rows)
        spreads = scores.sum(0)  # (E, F)
        learnt = means.T @ (whole * means) + 2 / len(offsets) * spreads.T @ spreads
        return cls(scores, curvature, learnt)
