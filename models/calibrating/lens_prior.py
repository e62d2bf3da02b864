"""The prior of lenses and rig, and other camera models."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import RigPrior
from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    EXTRINSICS,
    FOCAL,
    LENS,
    RADIAL,
    RADIAL_2,
    VIEW,
    Rig,
    make_rig,
)
from models.calibrating.lens_groups import group_covariance
from models.calibrating.problem import CalibrationProblem, GivenPoses, Solution
from models.optics.lenses.projection import LENSES, index_of

Float64 = NDArray[np.float64]

# Figures: evidence/lenses.md.
# Standard deviations of numbers that are not given: of one kind of camera together, and of each
# camera about its kind.
FOCAL_SDS = (0.3, 0.01)  # of the log focal length
RADIAL_SDS = (0.2, 0.05)  # of the first radial coefficient
RADIAL_2_SDS = (0.07, 0.01)  # of the second
# Shapes are learnt from the frames that they are held against: on drawn rigs errors of lenses are
# so many times what their evidence gives, and so many times the noise over the subject's radius.
TOO_SURE, BIAS = 2.0, 5.0
PINHOLE = index_of("pinhole")
CENTRE_SD = 0.02  # of the principal point, as a share of the image's side
UNKNOWN_CENTRE_SD = 0.12  # of the middle of all images of unknown size, likewise


def rig_prior(problem: CalibrationProblem, rig: Rig, *, given_poses: GivenPoses | None) -> RigPrior:
    """Return the prior of the rig, with its free numbers."""
    views = len(rig.groups)
    total = VIEW * views
    precision, free = np.zeros((total, total)), np.zeros(total, bool)
    unknown = np.isinf(problem.lens_sds)  # (K, LENS)
    for number, (together, alone) in (
        (FOCAL, FOCAL_SDS),
        (RADIAL, RADIAL_SDS),
        (RADIAL_2, RADIAL_2_SDS),
    ):
        these = np.flatnonzero(unknown[:, number])
        index = VIEW * these + number
        covariance = group_covariance(problem.lens_groups[these], together, alone)
        precision[np.ix_(index, index)] = np.linalg.inv(covariance)
        free[index] = True
    for number in (CENTRE_X, CENTRE_Y):
        these = np.flatnonzero(unknown[:, number])
        index = VIEW * these + number
        precision[np.ix_(index, index)] = np.linalg.inv(_centre_covariance(problem, these))
        # The direction of a moving camera and its principal point are nearly interchangeable.
        free[index] = rig.group_count < views
    poses = extrinsics_prior(rig, given_poses)
    sds = np.concatenate((problem.lens_sds, poses.sds), 1).ravel()
    unsure = np.flatnonzero(np.isfinite(sds) & (sds > 0))
    precision[unsure, unsure] = 1 / sds[unsure] ** 2
    free[unsure] = True
    if problem.lens_posterior is not None:  # which has used what is given
        lenses = np.flatnonzero(problem.lens_sds[:, FOCAL] > 0)
        index, covariance = VIEW * lenses + FOCAL, problem.lens_posterior.of_kind
        precision[np.ix_(index, index)] = np.linalg.inv(covariance[np.ix_(lenses, lenses)])
        free[index] = True
    free.reshape(views, VIEW)[:, LENS:] = poses.sds > 0
    free.reshape(views, VIEW)[problem.kept] = False
    mean = make_rig(
        problem.reference.lenses, rig.groups, poses.rotations, poses.translations, rig.stretched
    )
    return RigPrior(mean, precision, free)


def extrinsics_prior(rig: Rig, given: GivenPoses | None) -> GivenPoses:
    """Return the prior of the extrinsics of a rig.

    The frame of reference of a group without given poses is its first camera.
    """
    views = len(rig.groups)
    sds = np.full((views, EXTRINSICS), np.inf) if given is None else given.sds.copy()
    held: NDArray[np.bool_] = np.all(np.isfinite(sds), 1)
    for group in range(rig.group_count):
        members = np.flatnonzero(rig.groups == group)
        if not held[members].any():
            sds[members[0]] = 0
    if given is None:
        return GivenPoses(rig.rotations, rig.translations, sds)
    return GivenPoses(
        np.where(held[:, None, None], given.rotations, rig.rotations),
        np.where(held[:, None], given.translations, rig.translations),
        sds,
    )


def _centre_covariance(problem: CalibrationProblem, views: NDArray[np.int64]) -> Float64:
    """Return the covariance (k, k) of one coordinate of the principal points of some views."""
    sides = problem.images.sizes[views].max(1)
    together = sides * np.where(problem.images.known[views], 0, UNKNOWN_CENTRE_SD)
    covariance: Float64 = np.outer(together, together) + np.diag((CENTRE_SD * sides) ** 2)
    return covariance


def other_lenses(
    problem: CalibrationProblem, solution: Solution
) -> list[tuple[str, CalibrationProblem, Solution]]:
    """Return other camera models for lenses that are not given: name, problem and start of each.

    The file of a camera model decides whether the estimated pinholes suggest it.
    """
    unknown = np.isinf(problem.lens_sds[:, RADIAL]) & (problem.reference.lenses.models == PINHOLE)
    if not unknown.any():
        return []
    lenses, usual = solution.rig.lenses, problem.reference.lenses
    trials: list[tuple[str, CalibrationProblem, Solution]] = []
    for index, lens in enumerate(LENSES):
        start = lens.start_from_pinhole(lenses.distortion[unknown])
        if start is None:
            continue
        models, distortion = lenses.models.copy(), lenses.distortion.copy()
        models[unknown], distortion[unknown] = index, start
        reference = problem.reference._replace(lenses=usual._replace(models=models))
        rig = solution.rig._replace(lenses=lenses._replace(distortion=distortion, models=models))
        trials.append(
            (lens.NAME, problem._replace(reference=reference), solution._replace(rig=rig))
        )
    return trials
