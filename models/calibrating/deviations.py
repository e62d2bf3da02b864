"""How surely a rig is known: standard deviations of what a self-calibration found of it."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.bone_lengths import find_bone_lengths
from models.bundle.problem import LENS, VIEW, Rig
from models.bundle.shared_likelihood import SharedLikelihood, likelihood_of_shared
from models.calibrating.lens_prior import rig_prior
from models.calibrating.problem import CLEAR, Problem, Solution

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MOST_LEARNT = 0.98  # share of what keypoints say of a direction that learning the shapes takes away
# Adjusting noisy structures towards the shape model pulls the cameras of two views at rest, which
# nothing else holds: on drawn rigs errors are so many times what the information says.
PULLED = 2.0
# What holds where no keypoint does: a rotation vector in radians, a translation in structures.
WIDEST_ROTATION, WIDEST_TRANSLATION = np.pi, 1e3


def deviations(problem: Problem, solution: Solution) -> Float64:
    """Return standard deviations (K, 11) of a finished solution; 0 for what was kept.

    Of the posterior in which the shape model and bone lengths are learnt from the same keypoints,
    made wider where errors are seen to be alike within frames and keypoints. Translations are in
    units of the structure: how surely their ratio to it is known.
    """
    rig, scene = solution.rig, solution.scene
    prior = rig_prior(problem, rig, given_poses=solution.given_poses)
    if not prior.free.any():
        return np.zeros((len(rig.groups), VIEW))
    likelihood = likelihood_of_shared(
        problem.views(solution.noise),
        rig,
        solution.prior,
        scene,
        free=prior.free,
        bones=find_bone_lengths(scene.points, problem.told) if solution.with_bones else None,
    )
    held = prior.precision + np.diag(_widest(len(rig.groups)))
    held = held[np.ix_(prior.free, prior.free)]
    given = solution.given_poses
    placed = np.zeros(len(rig.groups)) if given is None else given.held
    reported = _reported(rig, prior.free, likelihood, np.bincount(rig.groups, placed) > 1)
    sds = np.sqrt(_variances(likelihood, held, reported))
    noisy = solution.measured_noise > CLEAR * problem.size and not solution.with_bones
    pulled = noisy & (rig.members[rig.groups] == 2)  # (K,)
    return sds.reshape(-1, VIEW) * np.where(pulled, PULLED, 1.0)[:, None]


def _variances(likelihood: SharedLikelihood, held: Float64, reported: Float64) -> Float64:
    """Variances (T,) of `reported` (T, F) times the free numbers; `held` (F, F) by their prior."""
    fixed = np.linalg.inv(likelihood.curvature + held)  # shapes and bones as they are
    root = np.linalg.cholesky(fixed)
    values, vectors = np.linalg.eigh(root.T @ likelihood.learnt @ root)
    spread = reported @ root @ vectors
    posterior = (np.square(spread) / (1 - values.clip(0, MOST_LEARNT))).sum(1)
    carried = reported @ fixed
    clustered = (carried @ (likelihood.clustered + held) * carried).sum(1)
    alike = clustered / np.square(reported @ root).sum(1).clip(1e-300)
    variances: Float64 = posterior * alike.clip(1)
    return variances


def _reported(rig: Rig, free: Bool, likelihood: SharedLikelihood, scaled: Bool) -> Float64:
    """Derive what is reported, (T, F): translations are so relative to the structures' size.

    Not in groups (G,) that are `scaled`, whose unit two told poses give.
    """
    rows = np.eye(len(free))[:, free].reshape(len(rig.groups), VIEW, -1)
    growth = np.where(scaled[:, None], 0, likelihood.growth)[rig.groups]  # (K, F)
    rows[:, LENS + 3 :] -= rig.translations[..., None] * growth[:, None]
    return rows.reshape(len(free), -1)


def _widest(views: int) -> Float64:
    """Inverse variances (T,) that keep what no keypoint tells finite."""
    precision = np.zeros((views, VIEW))
    precision[:, LENS : LENS + 3] = 1 / WIDEST_ROTATION**2
    precision[:, LENS + 3 :] = 1 / WIDEST_TRANSLATION**2
    return precision.ravel()
