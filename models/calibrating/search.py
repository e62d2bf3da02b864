"""The search for an arrangement: handedness, moving cameras, told poses, cameras at rest.

What was told of lenses and poses is held against the keypoints at its end. If most of the lenses
prove wrong, what began with them is no good start, and the search begins anew without them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import WeakPerspectiveScene, starting_scene
from models.bundle.problem import FOCAL, VIEW
from models.calibrating.arrangement import Rest, find_rest
from models.calibrating.doubts import Checked, check_told
from models.calibrating.expectation_maximisation import learn
from models.calibrating.handedness import certainty, choose_hand
from models.calibrating.moving_lenses import MovingLenses, scan_moving_lenses
from models.calibrating.problem import Problem, Solution
from models.calibrating.told_cameras import (
    arrange_posed,
    disagreements,
    forget_lenses,
    in_words,
    poses_disagree,
)
from models.findings.advice import attempt_steps, noticed
from models.findings.finding import Finding
from models.numerics.steps import Steps
from models.settings.config import FitConfig

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

MOST_LENSES = 0.5  # share of the told lenses from which, refused, the search begins anew
DOUBTFUL_REST = 1.4  # times the noise of moving cameras: more, and declared rest is looked at again


class Arranged(NamedTuple):
    """A solution with its cameras told at rest or moving."""

    told: Solution  # everything as it was told
    checked: Checked  # as far as the keypoints bear that out
    reason: str
    hand: float  # how sure the hand is, 0 to 1
    findings: tuple[Finding, ...]
    unit: float | None = None  # of a unit of the structure in the user's, if poses were given
    # Standard deviations (K, VIEW) of cameras that are settled, whatever shapes say; infinite of
    # those that are not. None: no camera is.
    kept: Float64 | None = None


def search(problem: Problem, answers: WeakPerspectiveScene, config: FitConfig) -> Steps[Arranged]:
    """Find what rests and what moves, from the network's answers.

    Raises
    ------
    NothingFoundError
        When no frame can be explained at all.
    """
    found = yield from _search(problem, answers, config)
    told: Bool = np.any(np.isfinite(problem.lens_sds), 1)  # (K,)
    refused: Bool = np.all(np.isinf(found.checked.problem.lens_sds), 1) & told
    if refused.sum() < max(2, MOST_LENSES * told.sum()):
        return found
    anew = yield from _search(forget_lenses(problem, refused), answers, config)
    of_lenses = tuple(doubt for doubt in found.checked.doubts if doubt.part == "lens")
    findings = noticed(disagreements, problem, found.told, anew.checked._replace(doubts=of_lenses))
    reason = anew.reason + in_words(findings)
    return anew._replace(reason=reason, findings=anew.findings + findings)


def _search(problem: Problem, answers: WeakPerspectiveScene, config: FitConfig) -> Steps[Arranged]:
    scene = starting_scene(answers, problem.reference)
    handed = yield from choose_hand(problem, scene, config.hand)
    moving = yield from learn(problem, handed.solution)
    findings: tuple[Finding, ...] = ()
    if len(problem.posed) > 1:
        posed = yield from arrange_posed(problem, moving)
        if posed.fits:
            findings = noticed(disagreements, problem, posed.told, posed.checked, posed.unit)
            reason = "the poses of the cameras were given" + in_words(findings)
            return Arranged(posed.told, posed.checked, reason, 1.0, findings, posed.unit)
        findings = noticed(poses_disagree, problem, posed.told, moving)
    if config.cameras == "moving":
        said = "the cameras were declared moving"
        rest = Rest(moving, said, [handed.log_odds], problem.lens_groups)
    else:
        declared, hint = config.cameras == "static", config.hand
        rest = yield from find_rest(problem, handed, moving, declared=declared, hint=hint)
        if declared and rest.solution.noise > DOUBTFUL_REST * moving.noise:
            freely = yield from attempt_steps(
                find_rest(problem, handed, moving, declared=False, hint=hint), rest
            )
            findings += noticed(_against_declared_rest, rest.solution, freely.solution)
    told, problem = rest.solution, problem._replace(lens_groups=rest.lens_groups)
    kept = rest.kept
    if not told.rig.resting.any() and np.isinf(problem.lens_sds[:, FOCAL]).all():
        scanned = MovingLenses(told, np.full((len(problem.poses), VIEW), np.inf), rest.lens_groups)
        scanned = yield from attempt_steps(scan_moving_lenses(problem, told), scanned)
        told, kept = scanned.solution, scanned.deviations
        problem = problem._replace(lens_groups=scanned.groups)
    checked = yield from check_told(problem, told)
    findings += noticed(disagreements, problem, told, checked)
    hand = 1.0 if config.handedness is not None else certainty(rest.evidence)
    reason = rest.reason + in_words(findings)
    # What a told lens is found to be, once it is refused, is no longer the rigid scene's.
    kept = None if checked.doubts else kept
    return Arranged(told, checked, reason, hand, findings, kept=kept)


def _against_declared_rest(resting: Solution, found: Solution) -> tuple[Finding, ...]:
    """Return the finding that cameras declared to rest move, if they were `found` to."""
    views = np.flatnonzero(~found.rig.resting).tolist()
    if not views:
        return ()
    return (
        Finding.of(
            "rig_declared_but_moving",
            views=views,
            noise_at_rest=resting.measured_noise,
            noise=found.measured_noise,
        ),
    )
