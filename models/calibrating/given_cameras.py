"""Given poses and a known length, and the findings about given values."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import gather
from models.bundle.problem import EXTRINSICS, Scene, make_rig
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
from models.settings.calibration import KnownLength

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MISFIT = 0.05  # of the log of a length: two units that differ by more contradict each other
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


def unit_by_length(
    scene: Scene, known: KnownLength, unit: float | None
) -> tuple[float, tuple[Finding, ...]]:
    """Return the unit from a known length, and a finding if given poses have another.

    It is a unit of the structure in the user's unit.
    """
    a, b = known.ends
    lengths = np.linalg.norm(scene.points[:, a] - scene.points[:, b], axis=-1)
    by_length = known.length / float(lower_median(np.exp(scene.sizes[:, 0]) * lengths))
    if unit is None or abs(math.log(by_length / unit)) <= MISFIT:
        return by_length, ()
    return by_length, (Finding.of("known_length_disagrees", ratio=by_length / unit),)
