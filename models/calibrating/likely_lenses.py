"""Camera models that lenses look like, tried by expectation maximisation."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.calibrating.arrangement_search import Arranged
from models.calibrating.expectation_maximisation import learn
from models.calibrating.lens_prior import TOO_SURE, other_lenses, rig_prior
from models.calibrating.problem import CalibrationProblem, Solution
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MOST_FRAMES = 400  # that are used
FEW_FRAMES = 80  # on which other camera models are tried first
BETTER_LENS = 10.0  # by so much the log posterior of another camera model must be better
MOST_REPEATS, STEADY = 5, 0.01  # of learning; change of a log focal length that ends it
# Squared distance of two log focal lengths from their posterior mean, in its deviations: a
# hundredth of all distances are larger (chi-squared, two degrees of freedom).
FAR_OFF = 9.21


class RefinedCameras(NamedTuple):
    """Cameras after all refinements."""

    problem: CalibrationProblem
    best: Solution
    kept: Float64 | None  # as in `Arranged`
    reason: str


def within(refined: RefinedCameras) -> bool:
    """Whether two lenses are where their posterior expects them; True without one."""
    problem, posterior = refined.problem, refined.problem.lens_posterior
    if posterior is None:
        return True
    off = np.log(refined.best.rig.lenses.focals.mean(1) / problem.side) - posterior.mean
    return float(off @ np.linalg.solve(posterior.of_kind, off)) < FAR_OFF


def with_likely_lenses(arranged: Arranged, share: float) -> Steps[RefinedCameras]:
    """Try the camera models that the lenses look like, and take the one that explains best.

    Lenses of two noisy views drift as they are learnt on: then another model is not taken.
    """
    (problem, best, _), kept, reason = arranged.checked, arranged.kept, arranged.reason
    if len(problem.poses) == 2:  # shapes alone distinguish their lenses
        share /= TOO_SURE**2
    few, every = (evenly_spread(len(problem.keypoints), most) for most in (FEW_FRAMES, MOST_FRAMES))
    promising = BETTER_LENS / 2 * len(few) / len(every)  # half of what so many frames should show
    for name, tried_problem, tried_start in other_lenses(problem, best):
        found = (problem, best), (tried_problem, tried_start)
        try:
            if len(few) < len(every) and (yield from _gain(*found, share, few))[0] < promising:
                continue
            gain, rival, trial = yield from _gain(*found, share, every)
            if gain < BETTER_LENS:
                continue
            trial = yield from until_steady(tried_problem, trial)
        except np.linalg.LinAlgError:  # the keypoints do not determine such lenses
            continue
        bent = RefinedCameras(tried_problem, trial, None, "")
        if trial.measured_noise <= rival.measured_noise and within(bent):
            problem, best, kept = tried_problem, trial, None
            reason = f"{reason}; {name} lenses explain the keypoints better"
    return RefinedCameras(problem, best, kept, reason)


def _gain(
    ours: tuple[CalibrationProblem, Solution],
    theirs: tuple[CalibrationProblem, Solution],
    share: float,
    frames: Int64,
) -> Steps[tuple[float, Solution, Solution]]:
    """Learn two camera models from some frames; return the second's gain in log posterior, too."""
    problem, tried = ours[0].of(frames), theirs[0].of(frames)
    rival = yield from learn(problem, ours[1].of(frames))
    trial = yield from learn(tried, theirs[1].of(frames))
    gain = _log_posterior(tried, trial, share) - _log_posterior(problem, rival, share)
    return gain, rival, trial


def until_steady(
    problem: CalibrationProblem, solution: Solution, *, with_bones: bool = False
) -> Steps[Solution]:
    """Learn on until focal lengths are steady: the start was far off, as of another model."""
    for _ in range(MOST_REPEATS):
        learnt = yield from learn(problem, solution, with_bones=with_bones)
        before, solution = solution, learnt
        if np.abs(np.log(solution.rig.lenses.focals / before.rig.lenses.focals)).max() < STEADY:
            break
    return solution


def _log_posterior(problem: CalibrationProblem, solution: Solution, share: float) -> float:
    """Return the log posterior of lenses, up to a constant.

    Noise below its lower limit counts as no better, because no lens model is so exact. If noise was
    removed, only the share `share` of keypoints counts as independent.
    """
    believed = rig_prior(problem, solution.rig, given_poses=solution.given_poses)
    numbers = share * 2 * int((problem.weights > 0).sum())
    return -numbers * math.log(solution.noise) - believed.cost(solution.rig) / 2
