"""What the user told of the cameras, held against the keypoints."""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import gather
from models.bundle.problem import EXTRINSICS, Scene, make_rig
from models.calibrating.problem import GivenPoses, Problem, Solution, grouped
from models.findings.finding import Finding
from models.numerics.medians import lower_median
from models.settings.calibration import KnownLength

Float64 = NDArray[np.float64]

MISFIT = 0.05  # of the log of a length: two statements that differ by more contradict each other


def given_poses(problem: Problem, moving: Solution) -> tuple[Solution, float]:
    """Put the moving solution into the poses that the user gave; also a unit in the user's."""
    rotations, translations = moving.rig.rotations.copy(), moving.rig.translations.copy()
    for k in problem.posed:
        pose = problem.poses[k]
        if pose is not None:
            rotations[k], translations[k] = pose
    groups = grouped(problem.posed, len(rotations))
    rig = make_rig(moving.rig.lenses, groups, rotations, translations)
    scene = gather(moving.scene, rig, problem.weights.sum(-1) > 0)
    log_unit = float(lower_median(scene.sizes[:, 0]))
    unit = math.exp(log_unit)
    sizes, shifts = scene.sizes.copy(), scene.translations.copy()
    sizes[:, 0] -= log_unit
    shifts[:, 0] /= unit
    rig = rig._replace(translations=rig.translations / unit)
    sds = np.full((len(rotations), EXTRINSICS), np.inf)
    sds[problem.posed] = 0
    start = moving._replace(
        rig=rig,
        scene=scene._replace(sizes=sizes, translations=shifts),
        given_poses=GivenPoses(rig.rotations, rig.translations, sds),
    )
    return start, unit


def unit_by_length(
    scene: Scene, known: KnownLength, unit: float | None
) -> tuple[float, tuple[Finding, ...]]:
    """Return the unit that a known length gives, and a finding if that of given poses is another.

    A unit is what a unit of the structure is in the user's.
    """
    a, b = known.keypoints
    lengths = np.linalg.norm(scene.points[:, a] - scene.points[:, b], axis=-1)
    by_length = known.length / float(lower_median(np.exp(scene.sizes[:, 0]) * lengths))
    if unit is None or abs(math.log(by_length / unit)) <= MISFIT:
        return by_length, ()
    return by_length, (Finding.of("known_length_disagrees", ratio=by_length / unit),)
