"""What is believed of lenses and rig beforehand, other camera models, and how sure all is."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import RigPrior
from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    FOCAL,
    LENS,
    RADIAL,
    RADIAL_2,
    VIEW,
    Rig,
    make_rig,
)
from models.calibrating.problem import Problem, Solution
from models.optics.lenses.projection import LENSES, index_of

Float64 = NDArray[np.float64]

# Standard deviations of what is not told: of all cameras together, and of each beside that.
FOCAL_SDS = (0.3, 0.01)  # of the log focal length
RADIAL_SDS = (0.2, 0.05)  # of the first radial coefficient
RADIAL_2_SDS = (0.1, 0.02)  # of the second
PINHOLE = index_of("pinhole")
CENTRE_SD = 0.02  # of the principal point, as a share of the image's side
UNTOLD_CENTRE_SD = 0.12  # of the middle of all images whose size nobody told, likewise


def rig_prior(problem: Problem, rig: Rig, *, given_poses: bool) -> RigPrior:
    """Say what is free of the rig, and how strongly it is held where.

    With `given_poses` the rig's extrinsics are those that the user gave, and stay.
    """
    views = len(rig.groups)
    total = VIEW * views
    precision, free = np.zeros((total, total)), np.zeros(total, bool)
    untold = np.isinf(problem.lens_sds)  # (K, LENS)
    for number, (together, alone) in (
        (FOCAL, FOCAL_SDS),
        (RADIAL, RADIAL_SDS),
        (RADIAL_2, RADIAL_2_SDS),
    ):
        index = VIEW * np.flatnonzero(untold[:, number]) + number
        covariance = together**2 + alone**2 * np.eye(len(index))
        precision[np.ix_(index, index)] = np.linalg.inv(covariance)
        free[index] = True
    for number in (CENTRE_X, CENTRE_Y):
        these = np.flatnonzero(untold[:, number])
        index = VIEW * these + number
        precision[np.ix_(index, index)] = np.linalg.inv(_centre_covariance(problem, these))
        # Where a moving camera looks and where its principal point is are nearly one.
        free[index] = rig.group_count < views
    for k, number in np.argwhere(~untold & (problem.lens_sds > 0)):
        precision[VIEW * k + number, VIEW * k + number] = 1 / problem.lens_sds[k, number] ** 2
        free[VIEW * k + number] = True
    if not given_poses:
        first_of_group = np.unique(rig.groups, return_index=True)[1]
        extrinsics = np.ones((views, VIEW), bool)
        extrinsics[:, :LENS] = False
        extrinsics[first_of_group] = False  # its camera is the group's frame of reference
        free |= extrinsics.ravel()
    mean = make_rig(problem.reference.lenses, rig.groups, rig.rotations, rig.translations)
    return RigPrior(mean, precision, free)


def _centre_covariance(problem: Problem, views: NDArray[np.int64]) -> Float64:
    """Covariance (k, k) of one coordinate of the principal points of some views."""
    sides = problem.images.sizes[views].max(1)
    together = sides * np.where(problem.images.told[views], 0, UNTOLD_CENTRE_SD)
    covariance: Float64 = np.outer(together, together) + np.diag((CENTRE_SD * sides) ** 2)
    return covariance


def deviations(problem: Problem, solution: Solution) -> Float64:
    """Return standard deviations (K, 11) from the information; 0 for what was kept."""
    free = rig_prior(problem, solution.rig, given_poses=solution.given_poses).free
    sds = np.zeros(len(free))
    tolerance = len(solution.information) * np.finfo(np.float64).eps
    inverse = np.linalg.pinv(solution.information, rcond=tolerance, hermitian=True)
    sds[free] = np.sqrt(inverse.diagonal().clip(0))
    return sds.reshape(-1, VIEW)


def other_lenses(problem: Problem, solution: Solution) -> list[tuple[str, Problem, Solution]]:
    """Camera models that the lenses look like which nobody told: name, problem and start of each.

    Their own files say what they look like to the pinholes that every search begins with.
    """
    untold = np.isinf(problem.lens_sds[:, RADIAL]) & (problem.reference.lenses.models == PINHOLE)
    if not untold.any():
        return []
    lenses, usual = solution.rig.lenses, problem.reference.lenses
    trials: list[tuple[str, Problem, Solution]] = []
    for index, lens in enumerate(LENSES):
        start = lens.start_from_pinhole(lenses.distortion[untold])
        if start is None:
            continue
        models, distortion = lenses.models.copy(), lenses.distortion.copy()
        models[untold], distortion[untold] = index, start
        reference = problem.reference._replace(lenses=usual._replace(models=models))
        rig = solution.rig._replace(lenses=lenses._replace(distortion=distortion, models=models))
        trials.append(
            (lens.NAME, problem._replace(reference=reference), solution._replace(rig=rig))
        )
    return trials
