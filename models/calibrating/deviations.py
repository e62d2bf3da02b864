"""Standard deviations of the cameras of a self-calibration."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.bone_lengths import find_bone_lengths
from models.bundle.problem import FOCAL, LENS, VIEW, Rig
from models.bundle.shared_likelihood import SharedLikelihood, likelihood_of_shared
from models.calibrating.lens_prior import BIAS, rig_prior
from models.calibrating.problem import CLEAR, CalibrationProblem, Solution

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MOST_LEARNT = 0.98  # largest share of a direction's information that is lost to learning the shapes
# Adjusting noisy structures towards the shape model biases the cameras of two static views, which
# are held by nothing else: on drawn rigs errors are so many times those of the information.
PULLED = 2.0
# Standard deviations without any keypoint: rotation vector in radians, translation in structures.
WIDEST_ROTATION, WIDEST_TRANSLATION = np.pi, 1e3


def deviations(problem: CalibrationProblem, solution: Solution) -> Float64:
    """Return standard deviations (K, 11) of a finished solution; 0 for numbers that were held.

    They are those of the posterior in which the shape model and bone lengths are learnt from the
    same keypoints, widened by the correlation of errors within frames and keypoints. Those of
    translations are of their ratio to the structure.
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
        bones=find_bone_lengths(scene.points, problem.measured) if solution.with_bones else None,
    )
    held = prior.precision + np.diag(_widest(len(rig.groups)))
    held = held[np.ix_(prior.free, prior.free)]
    given = solution.given_poses
    placed = np.zeros(len(rig.groups)) if given is None else given.held
    reported = _reported(rig, prior.free, likelihood, np.bincount(rig.groups, placed) > 1)
    sds = np.sqrt(_variances(likelihood, held, reported))
    noisy = solution.measured_noise > CLEAR * problem.size and not solution.with_bones
    pulled = noisy & (rig.members[rig.groups] == 2)  # (K,)
    sds = sds.reshape(-1, VIEW) * np.where(pulled, PULLED, 1.0)[:, None]
    # Shapes alone then give their lenses, and noise biases these as it does those of a scan.
    pulled &= np.isinf(problem.lens_sds[:, FOCAL])
    bias = BIAS * solution.measured_noise / problem.size
    sds[:, FOCAL] = np.where(pulled, np.hypot(sds[:, FOCAL], bias), sds[:, FOCAL])
    return sds


def _variances(likelihood: SharedLikelihood, held: Float64, reported: Float64) -> Float64:
    """Return variances (T,) of `reported` (T, F) times the free numbers, given `held` (F, F)."""
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
    """Return derivatives (T, F) of the reported numbers by the free ones.

    Translations are reported relative to the structures' size, except in groups (G,) that are
    `scaled`, whose unit two given poses fix.
    """
    rows = np.eye(len(free))[:, free].reshape(len(rig.groups), VIEW, -1)
    growth = np.where(scaled[:, None], 0, likelihood.growth)[rig.groups]  # (K, F)
    rows[:, LENS + 3 :] -= rig.translations[..., None] * growth[:, None]
    return rows.reshape(len(free), -1)


def _widest(views: int) -> Float64:
    """Return inverse variances (T,) that keep undetermined numbers finite."""
    precision = np.zeros((views, VIEW))
    precision[:, LENS : LENS + 3] = 1 / WIDEST_ROTATION**2
    precision[:, LENS + 3 :] = 1 / WIDEST_TRANSLATION**2
    return precision.ravel()
