"""What is believed of lenses and rig beforehand, and other camera models."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.adjustment import RigPrior
from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    EXTRINSICS,
    LENS,
    RADIAL,
    VIEW,
    Rig,
    make_rig,
)
from models.calibrating.problem import GivenPoses, LensBelief, Problem, Solution
from models.optics.lenses.projection import LENSES, index_of

Float64 = NDArray[np.float64]

# Standard deviations of what is not told: of all cameras together, of a kind of lenses beside that,
# and of each lens beside its kind.
FOCAL_SDS = (0.2, 0.35, 0.01)  # of the log focal length
RADIAL_SDS = (0.05, 0.1, 0.02)  # of the first radial coefficient
RADIAL_2_SDS = (0.05, 0.1, 0.02)  # of the second
PINHOLE = index_of("pinhole")
CENTRE_SD = 0.02  # of the principal point, as a share of the image's side
UNTOLD_CENTRE_SD = 0.12  # of the middle of all images whose size nobody told, likewise


def rig_prior(
    problem: Problem,
    rig: Rig,
    *,
    belief: LensBelief,
    given_poses: GivenPoses | None,
    every_centre: bool = False,
) -> RigPrior:
    """Say what is free of the rig, and how strongly it is held where.

    Where a moving camera looks and where its principal point is are nearly one: if all cameras
    move, their principal points are not sought. `every_centre` frees them all the same.
    """
    views = len(rig.groups)
    total = VIEW * views
    precision, free = np.zeros((total, total)), np.zeros(total, bool)
    untold = np.isinf(problem.lens_sds)  # (K, LENS)
    covariances = _lens_covariances(problem, belief)
    for number, covariance in enumerate(covariances):
        these = np.flatnonzero(untold[:, number])
        index = VIEW * these + number
        held = np.linalg.inv(covariance[np.ix_(these, these)])
        precision[np.ix_(index, index)] = belief.weight * held
        sought = every_centre or rig.group_count < views
        free[index] = sought or number not in (CENTRE_X, CENTRE_Y)
    poses = told_extrinsics(rig, given_poses)
    sds = np.concatenate((problem.lens_sds, poses.sds), 1).ravel()
    unsure = np.flatnonzero(np.isfinite(sds) & (sds > 0))
    precision[unsure, unsure] = 1 / sds[unsure] ** 2
    free[unsure] = True
    free.reshape(views, VIEW)[:, LENS:] = poses.sds > 0
    lenses = problem.reference.lenses
    centres = lenses.centres.copy()
    if belief.size is not None:
        assumed = ~problem.images.told & untold[:, CENTRE_X]
        centres[assumed] = np.array(belief.size) / 2
    mean = make_rig(
        lenses._replace(centres=centres), rig.groups, poses.rotations, poses.translations
    )
    return RigPrior(mean, precision, free)


def _lens_covariances(problem: Problem, belief: LensBelief) -> list[Float64]:
    """Covariances (K, K) over the views, one for each number of a lens, in their order."""
    views = len(belief.kinds)
    alike = belief.kinds[:, None] == belief.kinds

    def of_kinds(sds: tuple[float, float, float]) -> Float64:
        together, kind, alone = np.square(sds)
        covariance: Float64 = together + kind * alike + alone * np.eye(views)
        return covariance

    sides = problem.images.sizes.max(1)
    sized = problem.images.told | (belief.size is not None)
    together = sides * np.where(sized, 0, UNTOLD_CENTRE_SD)
    of_centres = np.outer(together, together) + np.diag((CENTRE_SD * sides) ** 2)
    radial = of_kinds(RADIAL_SDS), of_kinds(RADIAL_2_SDS)
    of_focals = of_kinds(FOCAL_SDS) + belief.misfit**2 * np.eye(views)
    return [of_focals, of_centres, of_centres, *radial]


def told_extrinsics(rig: Rig, given: GivenPoses | None) -> GivenPoses:
    """Return what holds the extrinsics of a rig.

    A group of which no pose was told has its frame of reference in its first camera.
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
