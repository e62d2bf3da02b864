"""Given poses, a known length or distance, and the findings about given values."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import gather
from models.bundle.problem import EXTRINSICS, LENS, make_rig
from models.calibrating.doubts import (
    GROSS,
    Checked,
    check_given,
)
from models.calibrating.expectation_maximisation import learn
from models.calibrating.problem import (
    NOISE_SLACK,
    CalibrationProblem,
    GivenPoses,
    Solution,
    grouped,
)
from models.findings.finding import Finding
from models.numerics.medians import lower_median
from models.numerics.steps import Steps
from models.optics.lenses.projection import Lenses
from models.settings.config import FitConfig

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MISFIT = 0.05  # of the log of a length: two units that differ by more contradict each other
UNSURE = 3  # standard deviations of the distance of two cameras that it may be off
WRONG_POSES = 2.5  # times the noise of moving cameras: given poses that leave more are wrong


class Posed(NamedTuple):
    """Cameras at their given poses, unless the keypoints contradict these."""

    as_given: Solution  # with all given values
    checked: Checked
    unit: float  # a unit of the structure in the user's unit
    fits: bool  # whether two given poses or more fit


def arrange_posed(problem: CalibrationProblem, moving: Solution) -> Steps[Posed]:
    """Set views to their given poses, and refine or refuse those of single views that are wrong."""
    start, unit = given_poses(problem, moving)
    posed = yield from learn(problem, start)
    checked = yield from check_given(problem, posed)
    given, solution = checked.solution.given_poses, checked.solution
    bound = WRONG_POSES * moving.noise + NOISE_SLACK * problem.side
    fits = given is not None and given.held.sum() > 1 and solution.noise <= bound
    return Posed(posed, checked, unit, bool(fits))


def given_poses(problem: CalibrationProblem, moving: Solution) -> tuple[Solution, float]:
    """Set the moving solution to the given poses; return also a unit of the structure."""
    rotations, translations = moving.rig.rotations.copy(), moving.rig.translations.copy()
    for k in problem.posed:
        pose = problem.poses[k]
        if pose is not None:
            rotations[k], translations[k] = pose
    groups = grouped(problem.posed, len(rotations))
    rig = make_rig(moving.rig.lenses, groups, rotations, translations, moving.rig.stretched)
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


def forget_lenses(problem: CalibrationProblem, views: Bool) -> CalibrationProblem:
    """Return the problem without the given lenses of some `views` (K,)."""
    as_given, usual = problem.reference.lenses, problem.usual.lenses
    which = views[:, None]
    lenses = Lenses(
        np.where(which, usual.focals, as_given.focals),
        np.where(which, usual.centres, as_given.centres),
        np.where(which, usual.distortion, as_given.distortion),
        np.where(views, usual.models, as_given.models),
    )
    sds = np.where(which, np.inf, problem.lens_sds)
    reference = problem.reference._replace(lenses=lenses)
    return problem._replace(reference=reference, lens_sds=sds, geometry=None)


def disagreements(
    problem: CalibrationProblem, as_given: Solution, checked: Checked, unit: float = 1.0
) -> tuple[Finding, ...]:
    """Return a finding for every view with a given value that was refined or refused.

    `as_given` solves the `problem` with all given values. Shifts are in the user's unit; a unit of
    the structure is `unit`.
    """
    found = checked.solution
    evidence: dict[int, dict[str, float]] = {}
    for doubt in checked.doubts:
        for view in doubt.views:
            off = _lens_off if doubt.part == "lens" else _pose_off
            numbers = evidence.setdefault(view, {"refused": 0.0})
            numbers |= off(problem, as_given, found, view, unit)
            numbers["refused"] = max(numbers["refused"], float(doubt.off > GROSS))
    return tuple(
        _disagrees([view], as_given, found, numbers) for view, numbers in sorted(evidence.items())
    )


def poses_disagree(
    problem: CalibrationProblem, as_given: Solution, without: Solution
) -> tuple[Finding, ...]:
    """Return the finding that no two given poses fit each other, so none can be confirmed."""
    return (_disagrees(problem.posed, as_given, without, {"refused": 1.0}),)


def _disagrees(
    views: list[int], as_given: Solution, without: Solution, numbers: dict[str, float]
) -> Finding:
    noises = {"noise_as_given": as_given.measured_noise, "noise": without.measured_noise}
    finding = Finding.of("calibration_disagrees", views=views)
    return finding.with_evidence(noises | numbers)


def in_words(findings: tuple[Finding, ...]) -> str:
    """Return a text on refined and refused calibrations, to append to a reason."""
    words = ""
    for refused, verb in ((0.0, "refined"), (1.0, "refused")):
        views = [
            view
            for finding in findings
            if finding.evidence.get("refused") == refused
            for view in finding.views
        ]
        if views:
            words += f"; the calibration of views {views} was {verb}"
    return words


def _lens_off(
    problem: CalibrationProblem, _given: Solution, found: Solution, view: int, _unit: float
) -> dict[str, float]:
    given, ours = problem.reference.lenses, found.rig.lenses
    return {
        "focal_ratio": float((ours.focals[view] / given.focals[view]).mean()),
        "centre_px": float(np.linalg.norm(ours.centres[view] - given.centres[view])),
    }


def _pose_off(
    _problem: CalibrationProblem, as_given: Solution, found: Solution, view: int, unit: float
) -> dict[str, float]:
    turn = found.rig.rotations[view] @ as_given.rig.rotations[view].T
    shift = found.rig.translations[view] - as_given.rig.translations[view]
    return {
        "degrees": math.degrees(turned_by(turn)),
        "shift": unit * float(np.linalg.norm(shift)),
    }


def turned_by(rotation: Float64) -> float:
    """Return the angle of a rotation (3, 3), radians."""
    return math.acos(min(1.0, max(-1.0, (float(rotation.trace()) - 1) / 2)))


def measured_unit(
    found: Solution, sds: Float64, config: FitConfig, unit: float | None
) -> tuple[float | None, tuple[Finding, ...]]:
    """Return the unit from what was measured, and findings if the unit of given poses is another.

    It is a unit of the structure in the user's unit; None is unknown. A length goes before a
    distance between cameras. The bound of what contradicts grows with what `sds` (K, 11), the
    deviations of the cameras, leave open of that distance.
    """
    findings: tuple[Finding, ...] = ()
    bound, distance, length = MISFIT, config.known_distance, config.known_length
    if distance is not None:
        pair, rig = list(distance.views), found.rig
        centres = -np.einsum("kji,kj->ki", rig.rotations[pair], rig.translations[pair])
        apart = float(np.linalg.norm(centres[1] - centres[0]))
        sd = float(np.linalg.norm(sds[pair, LENS + 3 :]))
        if rig.groups[pair[0]] != rig.groups[pair[1]] or not apart > sd:
            findings = (Finding.of("known_distance_not_used", views=pair),)
        else:
            bound = max(MISFIT, UNSURE * sd / apart)
            by_distance = distance.length / apart
            findings = _another_unit(by_distance, unit, bound)
            unit = by_distance
    if length is not None:
        a, b = length.ends
        lengths = np.linalg.norm(found.scene.points[:, a] - found.scene.points[:, b], axis=-1)
        by_length = length.length / float(lower_median(np.exp(found.scene.sizes[:, 0]) * lengths))
        findings += _another_unit(by_length, unit, bound)
        unit = by_length
    return unit, findings


def _another_unit(ours: float, theirs: float | None, bound: float) -> tuple[Finding, ...]:
    if theirs is None or abs(math.log(ours / theirs)) <= bound:
        return ()
    return (Finding.of("known_length_disagrees", ratio=ours / theirs),)
