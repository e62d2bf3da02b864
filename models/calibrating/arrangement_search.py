"""The search for an arrangement: handedness, moving cameras, given poses, static cameras.

Given lenses and poses are compared with the keypoints at its end. If most of the lenses prove
wrong, the result is no good start, and the search is repeated without them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import WeakPerspectiveScene, starting_scene
from models.calibrating.arrangement import StaticViews, find_static
from models.calibrating.doubts import Checked, check_given
from models.calibrating.expectation_maximisation import learn
from models.calibrating.given_cameras import (
    arrange_posed,
    disagreements,
    forget_lenses,
    in_words,
    poses_disagree,
)
from models.calibrating.handedness import certainty, choose_handedness
from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.moving_lenses import scan_moving_lenses, scanned_views
from models.calibrating.problem import CalibrationProblem, Solution, expecting_boxes
from models.epipolar.static_rig import StaticRig
from models.findings.advice import attempt_steps, noticed
from models.findings.finding import Finding
from models.numerics.steps import Steps
from models.settings.config import FitConfig

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

MOST_LENSES = 0.5  # share of the given lenses: if so many are refused, the search is repeated
DOUBTFUL_STATIC = 1.4  # times the noise of moving cameras: with more, `static` is doubted


class Arranged(NamedTuple):
    """A solution with static and moving cameras distinguished."""

    as_given: Solution  # with all given values
    checked: Checked  # with doubtful values refined or refused
    reason: str
    certain: float  # certainty of the handedness, 0 to 1
    findings: tuple[Finding, ...]
    unit: float | None = None  # of a unit of the structure in the user's, if poses were given
    # Standard deviations (K, VIEW) of cameras that are settled without shapes; infinite for the
    # others. None: no camera is.
    kept: Float64 | None = None


def search_arrangement(
    problem: CalibrationProblem, answers: WeakPerspectiveScene, config: FitConfig
) -> Steps[Arranged]:
    """Find static and moving cameras, from the network's answers.

    Raises
    ------
    NothingFoundError
        When no frame can be explained at all.
    """
    problem = expecting_boxes(problem)
    found = yield from _search(problem, answers, config)
    given: Bool = np.any(np.isfinite(problem.lens_sds), 1)  # (K,)
    refused: Bool = np.all(np.isinf(found.checked.problem.lens_sds), 1) & given
    if refused.sum() < max(2, MOST_LENSES * given.sum()):
        return found
    anew = yield from _search(forget_lenses(problem, refused), answers, config)
    of_lenses = tuple(doubt for doubt in found.checked.doubts if doubt.part == "lens")
    findings = noticed(
        disagreements, problem, found.as_given, anew.checked._replace(doubts=of_lenses)
    )
    reason = anew.reason + in_words(findings)
    return anew._replace(reason=reason, findings=anew.findings + findings)


def _search(
    problem: CalibrationProblem, answers: WeakPerspectiveScene, config: FitConfig
) -> Steps[Arranged]:
    scene = starting_scene(answers, problem.reference)
    handed = yield from choose_handedness(problem, scene, config.corners)
    moving = yield from learn(problem, handed.solution)
    findings: tuple[Finding, ...] = ()
    if len(problem.posed) > 1:
        posed = yield from arrange_posed(problem, moving)
        if posed.fits:
            findings = noticed(disagreements, problem, posed.as_given, posed.checked, posed.unit)
            reason = "the poses of the cameras were given" + in_words(findings)
            return Arranged(posed.as_given, posed.checked, reason, 1.0, findings, posed.unit)
        findings = noticed(poses_disagree, problem, posed.as_given, moving)
    if config.cameras == "moving":
        why = "the cameras were declared moving"
        static = StaticViews(moving, why, [handed.log_odds], problem)
    else:
        declared, hint = config.cameras == "static", config.corners
        static = yield from find_static(problem, handed, moving, declared=declared, hint=hint)
        if declared and static.solution.noise > DOUBTFUL_STATIC * moving.noise:
            freely = yield from geometry_of(problem, declared=False)
            findings += _against_declared_static(freely.rig, static.solution, moving)
    as_given, problem = static.solution, static.problem
    kept = static.kept
    if len(scanned_views(problem, as_given)):
        scanned = yield from attempt_steps(scan_moving_lenses(problem, as_given), None)
        if scanned is not None:
            as_given, of_moving, groups = scanned
            kept = of_moving if kept is None else np.minimum(kept, of_moving)
            problem = problem._replace(lens_groups=groups)
    checked = yield from check_given(problem, as_given)
    findings += noticed(disagreements, problem, as_given, checked)
    certain = 1.0 if config.handedness is not None else certainty(static.evidence)
    reason = static.reason + in_words(findings)
    # A refused lens that is estimated again is no longer that of the rigid scene.
    kept = None if checked.doubts else kept
    return Arranged(as_given, checked, reason, certain, findings, kept=kept)


def _against_declared_static(
    freely: StaticRig | None, static: Solution, moving: Solution
) -> tuple[Finding, ...]:
    """Return the finding that cameras declared static move, if geometry shows that some do."""
    views = range(len(static.rig.groups)) if freely is None else np.flatnonzero(~freely.static)
    if not len(views):
        return ()
    return (
        Finding.of(
            "rig_declared_but_moving",
            views=[int(view) for view in views],
            noise_if_static=static.measured_noise,
            noise=moving.measured_noise,
        ),
    )
