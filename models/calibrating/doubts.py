"""Whether the keypoints agree with given lenses and poses, view by view.

At the solution with all given numbers held, one linearisation gives how much better the keypoints
would be explained if one view's lens or pose were free (a score test; Cox & Hinkley, *Theoretical
Statistics*, sec. 9.3), and how far it would move. So nothing is learnt again unless a given value
is doubtful, and a wrong view is distinguished from its neighbours, whose errors grow too.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import OUTLIER
from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    FOCAL,
    LENS,
    RADIAL,
    VIEW,
    points_in_cameras,
)
from models.bundle.shared_likelihood import likelihood_of_shared
from models.calibrating.expectation_maximisation import learn
from models.calibrating.lens_prior import PINHOLE, rig_prior
from models.calibrating.problem import CalibrationProblem, Solution, copied, reprojection_distances
from models.findings.advice import attempt_steps
from models.numerics.medians import lower_median
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Part = Literal["lens", "pose"]

# Usual errors of correct calibrations; also the standard deviations of the prior of refined
# numbers. Focal lengths as a share of themselves, principal points of the image's side, radial
# coefficients in their unit, rotations in degrees, translations as a share of the distance of the
# subject.
USUAL_FOCAL_ERROR, USUAL_CENTRE_ERROR, USUAL_RADIAL_ERROR = 0.02, 0.01, 0.1
USUAL_TURN, USUAL_SHIFT = 0.8, 0.02
# Figures: evidence/given-values.md.
# A value that is off by more than so many usual errors is refused; below, it is refined.
GROSS = 4.0
# A view's noise with the given values, over its noise without. From these ratios on it is doubtful,
# if it is off by more than usual, and if it is far off.
DOUBTFUL, DOUBTFUL_IF_GROSS = 2.5, 1.3
MOST_OF_TOTAL = 0.9999  # largest share of the residuals that a linearisation may predict to remove
TOGETHER = 2.0  # times the gain of one view that freeing all lenses at once must have
AS_GOOD = 0.9  # share of the best gain from which two explanations of a view are equally good
KEPT_IF = 0.98  # share of the noise to which freeing a value must really reduce it
MOST_DOUBTS = 12  # that are settled one after the other
RIDGE = 1e-9  # share of the diagonal, for numbers that are undetermined


class Doubt(NamedTuple):
    """A given value that the keypoints contradict."""

    views: tuple[int, ...]
    part: Part
    gain: float  # of the robust squared residuals in variances, if it were free
    ratio: float  # the view's noise with the given value, over its noise without, as predicted
    off: float  # how far off it is, in usual errors of calibrations, as predicted


class Checked(NamedTuple):
    """A solution, and the given values that it does not use."""

    problem: CalibrationProblem
    solution: Solution
    doubts: tuple[Doubt, ...]


class FreedNumbers(NamedTuple):
    """A given value that may be wrong."""

    views: tuple[int, ...]
    part: Part
    numbers: Bool  # (K, VIEW) that would be free


def check_given(problem: CalibrationProblem, solution: Solution) -> Steps[Checked]:
    """Refine or refuse given values that are contradicted, one by one; most often there are none.

    Ends when fewer than two given poses are left, since it is then unknown which is wrong. An error
    is logged, and everything stays as it was given.
    """
    return (yield from attempt_steps(_checked(problem, solution), Checked(problem, solution, ())))


def _checked(problem: CalibrationProblem, solution: Solution) -> Steps[Checked]:
    found: list[Doubt] = []
    settled: set[tuple[int, Part]] = set()
    for _ in range(MOST_DOUBTS):
        trials = []
        for doubt in _worst_doubts(problem, solution, settled):
            freed, start = _without(problem, solution, doubt)
            learnt = yield from learn(freed, start)
            trials.append((doubt, freed, learnt))
        least = min((learnt.measured_noise for _, _, learnt in trials), default=math.inf)
        if least > KEPT_IF * solution.measured_noise:
            break
        # The nearest comes first.
        as_good = (trial for trial in trials if KEPT_IF * trial[2].measured_noise <= least)
        doubt, problem, solution = next(as_good)
        found.append(doubt)
        settled |= {(view, doubt.part) for view in doubt.views}
        if solution.given_poses is not None and solution.given_poses.held.sum() < 2:
            break
    return Checked(problem, solution, tuple(found))


def _worst_doubts(
    problem: CalibrationProblem, solution: Solution, settled: set[tuple[int, Part]]
) -> list[Doubt]:
    """Return the doubtful value that explains most if it is freed; none if nothing is doubtful.

    A camera that was turned and a principal point that is off look nearly alike, as do a focal
    length and a distance. So there may be two explanations of one view. The smaller change comes
    first, and measures the doubt.
    """
    candidates = [
        candidate
        for candidate in _candidates(problem, solution)
        if not any((view, candidate.part) in settled for view in candidate.views)
    ]
    if not candidates:
        return []
    scored = _scored(problem, solution, candidates)
    worst: list[Doubt] = []
    for view in range(len(problem.poses)):
        ours = [doubt for doubt in scored if doubt.views == (view,)]
        best = max((doubt.gain for doubt in ours), default=0.0)
        near = sorted((d for d in ours if d.gain >= AS_GOOD * best), key=lambda doubt: doubt.off)
        if near and _is_doubtful(near[0]) and (not worst or best > max(d.gain for d in worst)):
            worst = near
    together = [doubt for doubt in scored if len(doubt.views) > 1 and _is_doubtful(doubt)]
    if together and together[0].gain > TOGETHER * max((d.gain for d in worst), default=0.0):
        return together
    return worst


def _is_doubtful(doubt: Doubt) -> bool:
    if doubt.off < 1:
        return False
    return doubt.ratio > (DOUBTFUL_IF_GROSS if doubt.off > GROSS else DOUBTFUL)


def _candidates(problem: CalibrationProblem, solution: Solution) -> list[FreedNumbers]:
    """Return every view's given lens and pose, and all lenses together."""
    views = len(problem.poses)
    static = solution.rig.static
    lenses, candidates = [], []
    for k in range(views):
        numbers = np.zeros((views, VIEW), bool)
        numbers[k, :LENS] = np.isfinite(problem.lens_sds[k])
        if not static[k]:  # its principal point and its direction are nearly one
            numbers[k, CENTRE_X : CENTRE_Y + 1] = False
        if numbers.any():
            lenses.append(FreedNumbers((k,), "lens", numbers))
    candidates += lenses
    if len(lenses) > 1:
        every = np.any([candidate.numbers for candidate in lenses], 0)
        candidates.append(FreedNumbers(tuple(c.views[0] for c in lenses), "lens", every))
    given = solution.given_poses
    if given is not None and given.held.sum() > 1:
        for k in np.flatnonzero(given.held).tolist():
            numbers = np.zeros((views, VIEW), bool)
            numbers[k, LENS:] = True
            candidates.append(FreedNumbers((k,), "pose", numbers))
    return candidates


def _scored(
    problem: CalibrationProblem, solution: Solution, candidates: list[FreedNumbers]
) -> list[Doubt]:
    """Compute for every candidate the gain of freeing it, and how far its numbers would move."""
    views = len(problem.poses)
    prior = rig_prior(problem, solution.rig, given_poses=solution.given_poses)
    wanted = prior.free | np.any([candidate.numbers.ravel() for candidate in candidates], 0)
    index = np.flatnonzero(wanted)
    likelihood = likelihood_of_shared(
        problem.views(solution.noise),
        solution.rig,
        solution.prior,
        solution.scene,
        free=wanted,
        by_keypoint=False,
    )
    information = likelihood.curvature + prior.precision[np.ix_(index, index)]
    right = likelihood.score - (prior.precision @ prior.offset(solution.rig))[index]

    def best_step(free: Bool) -> tuple[float, Float64]:
        """Return twice the gain in log likelihood and the step (K, VIEW) with these (T,) free."""
        these = free[index]
        matrix = information[np.ix_(these, these)]
        matrix = matrix + np.diag(RIDGE * matrix.diagonal())
        step = np.zeros(len(free))
        step[index[these]] = np.linalg.solve(matrix, right[these])
        return float(step[index] @ right), step.reshape(views, VIEW)

    already = best_step(prior.free)[0] if prior.free.any() else 0.0
    total = _robust_total(problem, solution)
    distances = distances_of_subject(problem, solution)
    doubts = []
    for candidate in candidates:
        gain, step = best_step(prior.free | candidate.numbers.ravel())
        gain = min(max(gain - already, 0.0), MOST_OF_TOTAL * total)
        ratio = math.sqrt(1 + views / len(candidate.views) * gain / (total - gain))
        far = [
            how_far(problem, k, np.where(candidate.numbers[k], step[k], 0), distances[k])
            for k in candidate.views
        ]
        doubts.append(Doubt(candidate.views, candidate.part, gain, ratio, min(far)))
    return doubts


def how_far(problem: CalibrationProblem, view: int, step: Float64, distance: float) -> float:
    """Return the size of a step (VIEW,) of one view's numbers, in usual errors of calibrations."""
    side = float(problem.images.sizes[view].max())
    errors = usual_errors(side, distance)
    parts = (
        step[[FOCAL]],
        step[CENTRE_X : CENTRE_Y + 1],
        step[[RADIAL]],
        step[LENS : LENS + 3],
        step[LENS + 3 :],
    )
    starts = (FOCAL, CENTRE_X, RADIAL, LENS, LENS + 3)
    ratios = [np.linalg.norm(part) / errors[at] for part, at in zip(parts, starts, strict=True)]
    return float(max(ratios))


def usual_errors(side: float, distance: float) -> Float64:
    """Return usual errors (VIEW,) of a view's numbers, for an image's side and a distance."""
    errors = np.empty(VIEW)
    errors[FOCAL] = USUAL_FOCAL_ERROR
    errors[[CENTRE_X, CENTRE_Y]] = USUAL_CENTRE_ERROR * side
    errors[RADIAL:LENS] = USUAL_RADIAL_ERROR
    errors[LENS : LENS + 3] = math.radians(USUAL_TURN)
    errors[LENS + 3 :] = USUAL_SHIFT * distance
    return errors


def distances_of_subject(problem: CalibrationProblem, solution: Solution) -> Float64:
    """Median distance (K,) of the subject from each camera, units of the structure."""
    centres = points_in_cameras(solution.scene, solution.rig).mean(2)  # (N, K, 3)
    distances = np.linalg.norm(centres, axis=-1)
    seen = problem.weights.sum(-1) > 0
    return np.array(
        [
            float(lower_median(column[there])) if there.any() else 1.0
            for column, there in zip(distances.T, seen.T, strict=True)
        ]
    )


def _robust_total(problem: CalibrationProblem, solution: Solution) -> float:
    """Return the sum of the squared residuals in variances of the noise, with Huber's tails."""
    distances = reprojection_distances(problem, solution.rig, solution.scene)
    squared = problem.weights * np.square(distances / solution.noise)
    robust = np.where(squared > OUTLIER**2, 2 * OUTLIER * np.sqrt(squared) - OUTLIER**2, squared)
    return max(float(robust.sum()), 1e-9)


def _without(
    problem: CalibrationProblem, solution: Solution, doubt: Doubt
) -> tuple[CalibrationProblem, Solution]:
    """Return problem and start with a given value refined, or refused if it is far off."""
    gross = doubt.off > GROSS
    distances = distances_of_subject(problem, solution)
    for view in doubt.views:
        side = float(problem.images.sizes[view].max())
        errors = usual_errors(side, float(distances[view]))
        if doubt.part == "pose":
            solution = _with_pose_sds(solution, view, np.inf if gross else errors[LENS:])
        elif gross:
            problem, solution = _refuse_lens(problem, solution, view)
        else:
            given = np.isfinite(problem.lens_sds[view])
            sds = problem.lens_sds.copy()
            sds[view, given] = errors[:LENS][given]
            problem = problem._replace(lens_sds=sds)
    return problem, solution


def _with_pose_sds(solution: Solution, view: int, sds: Float64 | float) -> Solution:
    given = solution.given_poses
    if given is None:
        return solution
    changed = given.sds.copy()
    changed[view] = sds
    return solution._replace(given_poses=given._replace(sds=changed))


def _refuse_lens(
    problem: CalibrationProblem, solution: Solution, view: int
) -> tuple[CalibrationProblem, Solution]:
    """Estimate a view's lens as if it had not been given, starting from the given focal length."""
    usual, given, ours = problem.usual.lenses, problem.reference.lenses, solution.rig.lenses
    reference, start = copied(given), copied(ours)
    sds = problem.lens_sds.copy()
    sds[view] = np.inf
    for lenses in (reference, start):
        lenses.distortion[view] = 0
        lenses.models[view] = PINHOLE
    reference.focals[view], reference.centres[view] = usual.focals[view], usual.centres[view]
    return (
        problem._replace(reference=problem.reference._replace(lenses=reference), lens_sds=sds),
        solution._replace(rig=solution.rig._replace(lenses=start)),
    )
