"""Focal lengths of moving cameras, scanned over their range by the evidence of shapes.

Expectation maximisation alone may stop at focal lengths several times too long, because distant
cameras with long lenses leave the smallest differences between shapes. The evidence also accounts
for the number of structures that would look the same. First all focal lengths change by a common
factor. Then each changes alone, and if the evidence rises clearly, the lenses are unlike.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_evidence import log_evidence
from models.bundle.problem import FOCAL, VIEW
from models.calibrating.bagging import bagged_shares, filled, share_of_information
from models.calibrating.expectation_maximisation import learn
from models.calibrating.lens_prior import BIAS, FOCAL_SDS, TOO_SURE
from models.calibrating.problem import CalibrationProblem, Solution
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Figures: evidence/lenses.md.
FRAMES = 100  # at most, that shapes are learnt from
ROUNDS = 3  # of learning shapes
# Of the image's side: evidence distinguishes lenses by less than what their models leave.
LEAST_NOISE = 5e-5
LONGEST, SHORTEST = math.log(3.0), math.log(0.35)  # of the expected focal length
LEAST_DEVIATION = 0.08  # of a log focal length: usual errors of drawn rigs without noise
LEAST_INFORMATION = 1e-3  # of the evidence on a logarithm: next to none
STEP, FINE = 0.25, 0.0625  # of a log focal length, over the range and about the best
FINE_STEPS = 3  # to either side of the best
HOPELESS = 300.0  # nats: so much less log evidence than its best trial has ends a walk
UNLIKE = 10.0  # least difference of log posteriors in favour of unlike lenses
SURE = 3.0  # and its least size in standard deviations over frames
CLIMBS = (0.25, 0.25, 0.1)  # steps of a log focal length, one round each
PEAKS = 4  # steps from there to the top, at most


class MovingLenses(NamedTuple):
    """Moving cameras with the most likely focal lengths."""

    solution: Solution
    deviations: Float64  # (K, VIEW) standard deviations of scanned numbers, infinite for all others
    groups: Int64  # (K,) views of one number have alike lenses


class MovingTrial(NamedTuple):
    """A trial of focal lengths of M moving cameras."""

    at: Float64  # (M,) logs of the focal lengths over the usual ones
    solution: Solution
    evidence: Float64  # (N,) of each frame, weighted


Prior = Callable[[Float64], float]  # log density of the focal lengths of a trial


def scan_moving_lenses(problem: CalibrationProblem, solution: Solution) -> Steps[MovingLenses]:
    """Return moving cameras with the focal lengths under which shapes are most alike.

    Given focal lengths and static cameras of the `solution` stay. Lenses keep their distortion.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where shapes cannot be learnt.
    """
    views, everything = scanned_views(problem, solution), len(problem.poses)
    frames = evenly_spread(len(problem.keypoints), FRAMES)
    kept = problem._replace(kept=np.ones(everything, bool))
    part, usual = kept.of(frames), problem.reference.lenses.focals
    start = np.log(solution.rig.lenses.focals / usual).mean(1)[views]
    first = yield from _tried(part, start, MovingTrial(start, solution.of(frames), np.empty(0)))
    trials = [first]
    for step in (STEP, -STEP):
        trials += yield from _walk(part, first, step, within=(SHORTEST, LONGEST))
    best = _best(trials, _alike)
    for step in (FINE, -FINE):
        middle, reach = best.at.mean(), FINE_STEPS * FINE
        trials += yield from _walk(part, best, step, within=(middle - reach, middle + reach))
    best, groups = _best(trials, _alike), problem.lens_groups
    off = np.full(len(views), _common_deviation(trials, best))
    if problem.cameras_alike is not True and everything > 1:
        other = yield from _climb(part, best, CLIMBS[0])
        if problem.cameras_alike is False or _clearly_better(other, best):
            for step in CLIMBS[1:]:
                other = yield from _climb(part, other, step)
            groups = groups.copy()
            groups[views] = everything + np.arange(len(views))
            best, off = yield from _peak(part, other)
        else:  # deviations that span both answers
            half_log_share = -np.logaddexp(0.0, -_gain(other, best)) / 2
            apart = np.exp(half_log_share) * (other.at - best.at)
            off = np.hypot(off, apart)
    begun = _refocused(problem, solution, best.at - start)
    begun = begun._replace(shapes=best.solution.shapes, noise=best.solution.noise)
    learnt = yield from learn(kept, begun)
    # What models of shapes leave, and what noise biases.
    bias = BIAS * learnt.measured_noise / problem.size
    sds = np.full((everything, VIEW), np.inf)
    sds[views, FOCAL] = np.hypot(off, np.hypot(LEAST_DEVIATION, bias))
    return MovingLenses(learnt, sds, groups)


def scanned_views(problem: CalibrationProblem, solution: Solution) -> Int64:
    """Return the views that move and whose focal lengths are not given."""
    return np.flatnonzero(~solution.rig.static & np.isinf(problem.lens_sds[:, FOCAL]))


def _alike(at: Float64) -> float:
    """Return the log density of focal lengths that have a common factor."""
    return float(-((at.mean() / FOCAL_SDS[0]) ** 2) / 2)


def _unlike(at: Float64) -> float:
    """Return the log density of focal lengths that are independent of each other."""
    return float(-np.square(at / FOCAL_SDS[0]).sum() / 2)


def _walk(
    problem: CalibrationProblem, first: MovingTrial, step: float, *, within: tuple[float, float]
) -> Steps[list[MovingTrial]]:
    """Change all focal lengths step by step, each trial from the one before, within the range.

    The walk ends early once the evidence has fallen by `HOPELESS` since its best trial.
    """
    trials, near, best = [], first, first
    least, most = within
    while (near.at.mean() + step > least) if step < 0 else (near.at.mean() + step < most):
        try:
            near = yield from _tried(problem, near.at + step, near)
        except np.linalg.LinAlgError:
            break
        trials.append(near)
        ours, theirs = _evidence([best, near]).sum(1)
        if ours - theirs > HOPELESS:
            break
        best = best if ours > theirs else near
    return trials


def _climb(problem: CalibrationProblem, best: MovingTrial, step: float) -> Steps[MovingTrial]:
    """Change one focal length after another, each as long as the posterior rises."""
    for view in range(len(best.at)):
        for signed in (step, -step):
            while SHORTEST < best.at[view] + signed < LONGEST:
                at = best.at.copy()
                at[view] += signed
                try:
                    tried = yield from _tried(problem, at, best)
                except np.linalg.LinAlgError:
                    break
                fewer = np.isfinite(tried.evidence).sum() < np.isfinite(best.evidence).sum()
                if fewer or _best([best, tried], _unlike) is best:
                    break
                best = tried
    return best


def _tried(problem: CalibrationProblem, at: Float64, near: MovingTrial) -> Steps[MovingTrial]:
    """Learn shapes with held focal lengths, from a trial of others."""
    yield
    begun = _refocused(problem, near.solution, at - near.at)
    solution = yield from learn(problem, begun, rounds=ROUNDS, least_noise=LEAST_NOISE)
    views = problem.views(solution.noise)
    evidence = log_evidence(views, solution.rig, solution.prior, solution.scene)
    share = share_of_information(problem, solution.measured_noise) / TOO_SURE**2
    return MovingTrial(at, solution, share * evidence)


def _refocused(problem: CalibrationProblem, solution: Solution, steps: Float64) -> Solution:
    """Lengthen focal lengths by logs (M,), and move these cameras away by the same factors."""
    views, rig, scene = scanned_views(problem, solution), solution.rig, solution.scene
    focals, translations = rig.lenses.focals.copy(), scene.translations.copy()  # (N, G, 3)
    focals[views] *= np.exp(steps)[:, None]
    translations[:, rig.groups[views], 2] *= np.exp(steps)  # each a group of its own
    return solution._replace(
        rig=rig._replace(lenses=rig.lenses._replace(focals=focals)),
        scene=scene._replace(translations=translations),
    )


def _evidence(trials: list[MovingTrial]) -> Float64:
    """Return the evidence (T, N) of trials."""
    return filled(np.array([trial.evidence for trial in trials]))


def _best(trials: list[MovingTrial], prior: Prior) -> MovingTrial:
    """Return the trial with the highest posterior, the first of equal ones."""
    logs = _evidence(trials).sum(1) + [prior(trial.at) for trial in trials]
    return trials[int(logs.argmax())]


def _gain(unlike: MovingTrial, alike: MovingTrial) -> float:
    """Return the log odds of unlike lenses against alike ones."""
    evidence = _evidence([unlike, alike])
    gain = float((evidence[0] - evidence[1]).sum())
    return gain + _unlike(unlike.at) - _alike(alike.at)


def _clearly_better(unlike: MovingTrial, alike: MovingTrial) -> bool:
    """Whether unlike lenses are far more likely than alike ones, beyond the scatter of frames."""
    evidence = _evidence([unlike, alike])
    gains = evidence[0] - evidence[1]
    scatter = float(gains.std() * np.sqrt(len(gains)))
    return _gain(unlike, alike) > UNLIKE and float(gains.sum()) > SURE * scatter


def _common_deviation(trials: list[MovingTrial], best: MovingTrial) -> float:
    """Return the standard deviation of the common log focal length about the best."""
    trials = sorted(trials, key=lambda trial: float(trial.at.mean()))
    places = np.array([trial.at.mean() for trial in trials])
    widths = np.gradient(places) if len(places) > 1 else np.ones(1)
    prior = np.array([_alike(trial.at) for trial in trials])
    shares = bagged_shares(_evidence(trials), prior, widths)
    return float(np.sqrt(shares @ np.square(places - best.at.mean())))


def _peak(problem: CalibrationProblem, best: MovingTrial) -> Steps[tuple[MovingTrial, Float64]]:
    """Find the top of the posterior of unlike lenses, by Newton's method.

    Returns also standard deviations (M,) of the log focal lengths there.
    """
    slope, inverse, deviations = yield from _about(problem, best)
    for _ in range(PEAKS):
        step = (inverse @ slope).clip(-STEP, STEP)
        if np.abs(step).max() < FINE:
            break
        tried = yield from _tried(problem, best.at + step, best)
        if _best([best, tried], _unlike) is best:
            break
        best = tried
        slope, inverse, deviations = yield from _about(problem, best)
    return best, deviations


def _about(
    problem: CalibrationProblem, best: MovingTrial
) -> Steps[tuple[Float64, Float64, Float64]]:
    """Return slope (M,), inverse information (M, M) and deviations (M,) of unlike lenses.

    Curvatures are measured along each; correlations come from the gradients of frames, whose
    scatter also gives the sandwich estimator (Huber, 1967).
    """
    views = len(best.at)
    gradients, curvature = np.zeros((views, len(best.evidence))), np.zeros(views)
    for view, direction in enumerate(np.eye(views)):
        up = yield from _tried(problem, best.at + FINE * direction, best)
        down = yield from _tried(problem, best.at - FINE * direction, best)
        more, middle, less = _evidence([up, best, down])
        gradients[view] = (more - less) / (2 * FINE)
        curvature[view] = (2 * middle - more - less).sum() / FINE**2
    held = 1 / FOCAL_SDS[0] ** 2
    scatter = gradients - gradients.mean(1, keepdims=True)
    scores = scatter @ scatter.T
    sizes = np.sqrt(np.maximum(curvature, LEAST_INFORMATION) / scores.diagonal().clip(TINY))
    inverse = np.linalg.inv(sizes[:, None] * scores * sizes + held * np.eye(views))
    covariance = inverse + inverse @ scores @ inverse
    return gradients.sum(1) - held * best.at, inverse, np.sqrt(covariance.diagonal())
