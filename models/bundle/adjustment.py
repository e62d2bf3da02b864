"""Perspective maximum-a-posteriori adjustment of all frames and the rig that they share.

Levenberg-Marquardt with analytic Jacobians on the problem of `models.bundle.problem`; the parts of
one frame are compiled.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.bone_lengths import BoneLengths
from models.bundle.elimination import Reduced, eliminate_frames
from models.bundle.frame import CONVERGED, FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING
from models.bundle.problem import (
    CENTRE_X,
    LENS,
    POSE,
    RADIAL,
    VIEW,
    Rig,
    Scene,
    ShapePrior,
    Views,
    make_rig,
)
from models.bundle.separate_frames import costs_of, normal_equations
from models.numerics.rotations import rotations_from_vectors
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

# Places among a view's eleven numbers: the principal point, and the radial coefficients.
CENTRE, BENDING = slice(CENTRE_X, RADIAL), slice(RADIAL, LENS)
ROTATION, TRANSLATION = slice(LENS, LENS + 3), slice(LENS + 3, VIEW)
LONGEST_FOCAL_STEP = 0.5  # of the log focal length in one iteration


class RigPrior(NamedTuple):
    """Gaussian prior of the numbers that all frames share, eleven for each view; T = 11 K."""

    mean: Rig
    precision: Float64  # (T, T)
    free: NDArray[np.bool_]  # (T,) whether a number may change

    def offset(self, rig: Rig) -> Float64:
        """Return the rig minus the mean, (T,); extrinsics to first order."""
        ours, mean = rig.lenses, self.mean.lenses
        relative = rig.rotations @ self.mean.rotations.mT
        skew = (relative - relative.mT) / 2
        offset = np.empty((len(rig.groups), VIEW))
        offset[:, 0] = np.log(ours.focals / mean.focals).mean(-1)
        offset[:, CENTRE] = ours.centres - mean.centres
        offset[:, BENDING] = (ours.distortion - mean.distortion)[:, :2]
        offset[:, ROTATION] = np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), -1)
        offset[:, TRANSLATION] = rig.translations - self.mean.translations
        return offset.ravel()

    def cost(self, rig: Rig) -> float:
        """Minus twice the log density."""
        offset = self.offset(rig)
        return float(offset @ self.precision @ offset)


class Adjusted(NamedTuple):
    """The outcome of `adjust`."""

    rig: Rig
    scene: Scene


def move_scene(scene: Scene, points_step: Float64, others_step: Float64) -> Scene:
    """Apply steps of the points (N, P, 3) and of the other unknowns (N, R) to a scene."""
    frames, groups = scene.sizes.shape
    pose = others_step[:, : POSE * groups].reshape(frames, groups, POSE)
    return Scene(
        scene.points + points_step,
        rotations_from_vectors(pose[..., :3]) @ scene.rotations,
        scene.translations + pose[..., 3:6],
        scene.sizes + pose[..., 6].clip(-1, 1),
    )


def move_rig(rig: Rig, step: Float64) -> Rig:
    """Apply a step (T,) to a rig."""
    step = step.reshape(-1, VIEW)
    distortion = rig.lenses.distortion.copy()
    distortion[:, :2] += step[:, BENDING]
    growth = np.exp(step[:, :1].clip(-LONGEST_FOCAL_STEP, LONGEST_FOCAL_STEP))
    return make_rig(
        rig.lenses._replace(
            focals=rig.lenses.focals * growth,
            centres=rig.lenses.centres + step[:, CENTRE],
            distortion=distortion,
        ),
        rig.groups,
        rotations_from_vectors(step[:, ROTATION]) @ rig.rotations,
        rig.translations + step[:, TRANSLATION],
        rig.stretched,
    )


def adjust(
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    *,
    rig_prior: RigPrior,
    bones: BoneLengths | None = None,
    iterations: int = 20,
) -> Steps[Adjusted]:
    """Adjust frames and rig together, yielding after each iteration.

    The lengths of `bones` enter the equations of the shared numbers only; frames follow by their
    keypoints and the shape prior. Frames without a finite cost at the start are ignored.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the free numbers of the rig are not determined at all.
    """
    costs = costs_of(views, rig, prior, scene)
    kept = np.isfinite(costs)  # (N,)
    views = views._replace(weights=views.weights * kept[:, None, None])

    def total_cost(costs: Float64, scene: Scene, rig: Rig) -> float:
        total = costs[kept].sum() + rig_prior.cost(rig)
        return float(total if bones is None else total + bones.cost(scene.points)[kept].sum())

    best, damping = total_cost(costs, scene, rig), FIRST_DAMPING
    for _ in range(iterations):
        yield
        equations = normal_equations(views, rig, prior, scene, shared=True)
        reduced = eliminate_frames(equations, rig_prior.free, damping)
        information, right = _shared_equations(reduced, rig, rig_prior, scene, bones, kept)
        tried_rig, tried = _solved(reduced, information, right, damping, rig, rig_prior, scene)
        total = total_cost(costs_of(views, tried_rig, prior, tried), tried, tried_rig)
        if total <= best:
            gained = (best - total) / max(best, 1e-9)
            scene, rig, best = tried, tried_rig, total
            damping = max(damping / 10, LEAST_DAMPING)
            if gained < CONVERGED:
                break
        else:
            damping *= 10
            if damping > MOST_DAMPING:
                break
    return Adjusted(rig, scene)


def _shared_equations(
    reduced: Reduced,
    rig: Rig,
    rig_prior: RigPrior,
    scene: Scene,
    bones: BoneLengths | None,
    kept: NDArray[np.bool_],
) -> tuple[Float64, Float64]:
    """Return matrix (F, F) and right-hand side (F,) of the free shared numbers."""
    free = rig_prior.free
    information = reduced.information.sum(0) + rig_prior.precision[np.ix_(free, free)]
    right = reduced.right.sum(0) - (rig_prior.precision @ rig_prior.offset(rig))[free]
    if bones is None:
        return information, right
    offsets = bones.offsets(scene.points + reduced.points)  # (N, E)
    derived = bones.derivatives(scene.points, reduced.points_by_shared)  # (N, E, F)
    weighted = (bones.precision(offsets) * kept[:, None])[..., None] * derived
    rows = (offsets.size, len(right))
    weighted, derived = weighted.reshape(rows), derived.reshape(rows)
    return information + weighted.T @ derived, right - weighted.T @ offsets.ravel()


def _solved(
    reduced: Reduced,
    information: Float64,
    right: Float64,
    damping: float,
    rig: Rig,
    rig_prior: RigPrior,
    scene: Scene,
) -> tuple[Rig, Scene]:
    """Solve for the shared numbers, then for every frame; return rig and scene after that step."""
    damped = information + np.diag(damping * information.diagonal() + 1e-12)
    free_step = np.asarray(np.linalg.solve(damped, right), np.float64)  # (F,)
    step = np.zeros(len(rig_prior.free))
    step[rig_prior.free] = free_step
    # As one product: the shared numbers are few, the points are many.
    points_step = reduced.points + _times(reduced.points_by_shared, free_step)
    others_step = reduced.others + _times(reduced.others_by_shared, free_step)
    return move_rig(rig, step), move_scene(scene, points_step, others_step)


def _times(matrices: Float64, vector: Float64) -> Float64:
    rows = math.prod(matrices.shape[:-1])
    products: Float64 = matrices.reshape(rows, len(vector)) @ vector
    return products.reshape(matrices.shape[:-1])
