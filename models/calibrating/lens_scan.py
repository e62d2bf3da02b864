"""Focal lengths of two static views, scanned over their range by the evidence of shapes.

Keypoints of two views fit almost any two lenses, but with wrong ones a body changes its shape as
it turns. For each pair of focal lengths that is tried, the cameras are adjusted to the keypoints
and a shape model is learnt. The evidence is the likelihood of the keypoints under both. The width
of its peak, together with its scatter between frames, gives the uncertainty of the lenses.
"""

import math
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_evidence import log_evidence
from models.bundle.problem import FOCAL
from models.calibrating import bagging
from models.calibrating.expectation_maximisation import learn
from models.calibrating.keypoint_rig import (
    lens_beliefs,
    lens_kinds,
    static_start,
    straight_images,
)
from models.calibrating.lens_groups import (
    covariance_over_kinds,
    group_covariance,
    posterior_of_kinds,
)
from models.calibrating.lens_prior import FOCAL_SDS
from models.calibrating.problem import CalibrationProblem, Solution
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig
from models.epipolar.rig_certainty import FocalLikelihood, certainty_of
from models.epipolar.rig_search import refocused
from models.epipolar.robust_points import robust_points, robust_structures
from models.epipolar.static_cameras import CAMERA, FREEDOM, LENS, SeenPoints, distances_of
from models.epipolar.static_rig import StaticRig, StaticScene
from models.epipolar.view_graph import SharedPoints
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

FRAMES = 100  # at most, that shapes are learnt from
POINTS = 900  # that cameras are adjusted to
RIG_ITERATIONS, ROUNDS = 30, 5  # of adjusting cameras, and of learning shapes
# Of the image's side: evidence distinguishes lenses by less than what their models leave.
LEAST_NOISE = 5e-5
LONGEST, SHORTEST = math.log(3.0), math.log(0.35)  # of the expected focal length
COMMON_STEPS = 7  # between these
RATIO_STEP, MOST_RATIO = 0.3, 1.5  # of the log ratio of the two focal lengths
FINE = 0.08  # of either: half the width of the parabola at the peak
PEAKS = 3  # times the peak is looked for, from where the last parabola had it
LONGEST_STEP = 0.2  # from one parabola to the next
# Shapes are learnt from the frames that they are held against: on drawn rigs errors are so many
# times what the evidence gives.
TOO_SURE = 2.0
BIAS = 5.0  # times the noise over the subject's radius: usual errors of drawn rigs with much noise
LEAST_DEVIATION = 0.08  # of both logarithms: usual errors of drawn rigs without noise
LEAST_INFORMATION = 1e-3  # of the evidence on a logarithm: next to none
# Of the common log focal length and the log ratio, of lenses of two kinds.
PRIOR_SDS = FOCAL_SDS[0] * np.array([math.sqrt(0.5), math.sqrt(2.0)])
TINY = 1e-12
# From the common log focal length and the log ratio to the two logs, and back.
TO_LOGS = np.array([[1.0, 0.5], [1.0, -0.5]])
FROM_LOGS = np.linalg.inv(TO_LOGS)
RIGHT, UP = np.eye(2)


class Trial(NamedTuple):
    """Two static cameras with trial focal lengths."""

    at: Float64  # (2,) common log focal length in sides, and log ratio
    cameras: AdjustedRig
    shown: StaticScene  # the frames that are used
    solution: Solution  # of these
    evidence: Float64  # (N,) of each frame
    posterior: float  # log density of the focal lengths, up to a constant


class _Sight(NamedTuple):
    """The data of a scan: keypoints in sides, and the problem of the frames that are used."""

    problem: CalibrationProblem
    images: Float64  # (N, 2, P, 2)
    points: SeenPoints  # of the sample that cameras are adjusted to
    clusters: tuple[NDArray[np.int64], NDArray[np.int64]]  # frames and keypoints of these
    beliefs: Beliefs
    worth: float  # weight of the evidence, 0 to 1
    bias: float  # of the common log focal length and of the log ratio, as noise causes it


class _Peak(NamedTuple):
    """The most likely focal lengths of one handedness."""

    trial: Trial
    information: Float64  # (2, 2) of keypoints alone, on the numbers of `Trial.at`
    vector: Float64  # (2,) information times mean of keypoints alone
    moves: Float64  # (2, 2, 11) derivatives of the cameras' numbers by `at`


class _Around(NamedTuple):
    """A trial and its neighbours."""

    trials: list[Trial]  # itself, right, left, up, down, right and up

    @property
    def gradients(self) -> Float64:
        """Derivatives (2, N) of the evidence of each frame."""
        _, right, left, up, down, _ = (trial.evidence for trial in self.trials)
        return np.stack((right - left, up - down)) / (2 * FINE)

    @property
    def curvature(self) -> Float64:
        """Minus the second derivatives (2, 2) of the evidence of all frames."""
        middle, right, left, up, down, both = (trial.evidence for trial in self.trials)
        across = np.nansum(right + up - both - middle)
        along = np.nansum(2 * middle - right - left), np.nansum(2 * middle - up - down)
        return np.array([[along[0], across], [across, along[1]]]) / FINE**2

    @property
    def moves(self) -> Float64:
        """Derivatives (2, 2, 11) of the cameras' numbers."""
        middle, right, left, up, down, _ = self.trials
        return np.stack((_difference(right, left, middle), _difference(up, down, middle))) / (
            2 * FINE
        )


def scan_lenses(problem: CalibrationProblem, found: StaticRig) -> Steps[StaticRig]:
    """Return two static cameras with the focal lengths under which shapes are most alike.

    `found` are the cameras from geometry alone, and their handedness. They stay as they are if
    there are three or more, or if a focal length is given.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where shapes cannot be learnt.
    """
    if found.static.tolist() != [True, True] or np.isfinite(problem.lens_sds[:, FOCAL]).any():
        return found
    frames = evenly_spread(len(problem.keypoints), FRAMES)
    sight = _sight(problem, found, frames)
    noise = np.full(2, found.noise)
    points = robust_points(found.best.rig, sight.points, noise)
    peak = yield from _peak(sight, AdjustedRig(found.best.rig, points, noise))
    return (yield from _settled(problem, found, sight, peak))


def _sight(problem: CalibrationProblem, found: StaticRig, frames: NDArray[np.int64]) -> _Sight:
    """Take some frames, with keypoints weighted by Student's t."""
    images, _ = straight_images(problem, problem.keypoints)
    points = found.best.points[frames].reshape(-1, 3).T
    weights = problem.weights[frames]
    seen = SeenPoints(
        images[frames].transpose(1, 3, 0, 2).reshape(2, 2, -1),
        weights.transpose(1, 0, 2).reshape(2, -1),
    )
    distances = distances_of(found.best.rig, np.nan_to_num(points), seen)
    distances[:, np.isnan(points).any(0)] = 0  # one view alone does not show what is an outlier
    ratios = np.square(distances / max(found.noise, LEAST_NOISE))
    robust = FREEDOM / (FREEDOM + ratios).reshape(2, len(frames), -1)
    shared = SharedPoints.of(images, problem.weights, np.random.default_rng(0))
    chosen = shared.chosen([0, 1], POINTS)
    sample = shared.seen([0, 1], POINTS)
    worth = bagging.share_of_information(problem, found.noise * problem.side)
    return _Sight(
        problem.of(frames)._replace(weights=weights * robust.transpose(1, 0, 2)),
        images[frames],
        sample._replace(weights=worth * sample.weights),
        (shared.frames[chosen], shared.keypoints[chosen]),
        lens_beliefs(problem),
        worth / TOO_SURE**2,
        BIAS * found.noise * problem.side / problem.size,
    )


def _peak(sight: _Sight, cameras: AdjustedRig) -> Steps[_Peak]:
    """Scan the common focal length, then the ratio, then both about the peak.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where shapes cannot be learnt.
    """
    at = FROM_LOGS @ cameras.rig.log_focals
    first = yield from _tried(sight, at, cameras)
    usual = float(np.log(sight.beliefs.focals).mean())
    places = np.linspace(usual + SHORTEST, usual + LONGEST, COMMON_STEPS)
    trials = [first]
    for side in (places[places > at[0]], places[places < at[0]][::-1]):
        trials += yield from _walk(sight, first, [np.array([place, at[1]]) for place in side])
    best = max(trials, key=attrgetter("posterior"))
    if sight.problem.cameras_alike is not True:
        ratios = np.arange(RATIO_STEP, MOST_RATIO, RATIO_STEP)
        found = [best]
        for side in (1, -1):
            walk = [best.at + side * ratio * UP for ratio in ratios]
            found += yield from _walk(sight, best, walk, uphill=True)
        best = max(found, key=attrgetter("posterior"))
        trials += found[1:]
    for _ in range(PEAKS):
        around = yield from _around(sight, best)
        step = _step(sight, around)
        if np.abs(step).max() < FINE:
            break
        moved = yield from _tried(sight, best.at + step, best.cameras)
        better = max([*around.trials, moved], key=attrgetter("posterior"))
        if better is best:
            break
        best = better
    else:
        around = yield from _around(sight, best)
        step = _step(sight, around)
    top = best.at + step.clip(-FINE, FINE)
    return _Peak(best, *_likelihood(sight, around, trials, top), around.moves)


def _step(sight: _Sight, around: _Around) -> Float64:
    """Return the step to the top of the posterior, bounded in each direction."""
    matrix = sight.worth * around.curvature + np.diag(1 / PRIOR_SDS**2)
    offset = around.trials[0].at - _expected(sight.beliefs)
    pull = sight.worth * np.nansum(around.gradients, 1) - offset / PRIOR_SDS**2
    values, vectors = np.linalg.eigh(matrix)
    along = (vectors.T @ pull) / np.maximum(np.abs(values), LEAST_INFORMATION)
    return np.asarray(vectors @ along.clip(-LONGEST_STEP, LONGEST_STEP), np.float64)


def _expected(beliefs: Beliefs) -> Float64:
    """Return the expected focal lengths, in the form of `Trial.at`."""
    return np.asarray(FROM_LOGS @ np.log(beliefs.focals), np.float64)


def _walk(
    sight: _Sight, near: Trial, places: list[Float64], *, uphill: bool = False
) -> Steps[list[Trial]]:
    """Try one place after another, each from the previous one; `uphill` stops when it is worse."""
    trials: list[Trial] = []
    for place in places:
        try:
            tried = yield from _tried(sight, place, near.cameras)
        except np.linalg.LinAlgError:
            break
        trials.append(tried)
        if uphill and tried.posterior < near.posterior:
            break
        near = tried
    return trials


def _around(sight: _Sight, middle: Trial) -> Steps[_Around]:
    """Try focal lengths beside those of a trial."""
    right = yield from _tried(sight, middle.at + FINE * RIGHT, middle.cameras)
    left = yield from _tried(sight, middle.at - FINE * RIGHT, middle.cameras)
    up = yield from _tried(sight, middle.at + FINE * UP, middle.cameras)
    down = yield from _tried(sight, middle.at - FINE * UP, middle.cameras)
    both = yield from _tried(sight, middle.at + FINE * (RIGHT + UP), middle.cameras)
    return _Around([middle, right, left, up, down, both])


def _likelihood(
    sight: _Sight, around: _Around, trials: list[Trial], top: Float64
) -> tuple[Float64, Float64]:
    """Return information (2, 2) and information times mean (2,); `top` is the posterior's.

    Errors of frames are correlated. So in each direction the information is divided by the factor
    by which sums over frames scatter more (the design effect: Kish, *Survey Sampling*, 1965). In
    each direction the variance is at least that of the best trials of resampled frames, and that of
    the bias that noise causes. The pull away from the prior's mean shrinks likewise.
    """
    values, vectors = np.linalg.eigh(sight.worth * around.curvature)
    values = values.clip(LEAST_INFORMATION)
    gradients = sight.worth * around.gradients
    known = gradients[:, np.isfinite(gradients).all(0)]
    scores = vectors.T @ (known - known.mean(1, keepdims=True))
    effect = np.maximum(1.0, np.square(scores).sum(1) / values)
    information = (vectors * (values / effect)) @ vectors.T
    tried = [*trials, around.trials[0]]
    offsets = np.array([trial.at - around.trials[0].at for trial in tried])
    places = np.array([trial.at for trial in tried]) - _expected(sight.beliefs)
    evidence = sight.worth * bagging.filled(np.array([trial.evidence for trial in tried]))
    shares = bagging.bagged_shares(evidence, -np.square(places / PRIOR_SDS).sum(1) / 2)
    widest = (offsets.T * shares) @ offsets + (sight.bias**2 + TINY) * np.eye(2)
    limited = bagging.at_most(information, widest)
    share = limited @ (vectors / values) @ vectors.T  # of the evidence that is believed
    return limited, limited @ top + share @ ((top - _expected(sight.beliefs)) / PRIOR_SDS**2)


def _tried(sight: _Sight, at: Float64, near: AdjustedRig) -> Steps[Trial]:
    """Adjust cameras that were tried near them and learn shapes, with focal lengths held.

    In each trial shapes are learnt anew, for equally many rounds, so that none has an advantage.
    """
    yield
    rig = refocused(near.rig, near.points, TO_LOGS @ at)
    beliefs = _held(sight.beliefs, rig.log_focals)
    points = robust_points(rig, sight.points, near.noise)
    cameras = adjust_rig(rig, points, sight.points, beliefs, iterations=RIG_ITERATIONS)
    weights = sight.problem.weights
    structures = robust_structures(cameras.rig, sight.images, weights, cameras.noise)
    shown = StaticScene(cameras.rig, structures)
    problem = sight.problem._replace(kept=np.ones(2, bool))
    start = static_start(problem, shown, float(np.median(cameras.noise)) * problem.side)
    if start is None:
        raise np.linalg.LinAlgError("no structure can be located")
    solution = yield from learn(problem, start, rounds=ROUNDS, least_noise=LEAST_NOISE)
    views = problem.views(solution.noise)
    evidence = log_evidence(views, solution.rig, solution.prior, solution.scene)
    offsets = (at - _expected(sight.beliefs)) / PRIOR_SDS
    posterior = sight.worth * float(np.nansum(evidence)) - float(offsets @ offsets) / 2
    return Trial(at, cameras, shown, solution, evidence, posterior)


def _held(beliefs: Beliefs, log_focals: Float64) -> Beliefs:
    """Hold the focal lengths."""
    return replace(
        beliefs, focals=np.exp(log_focals), focal_covariance=np.zeros((2, 2)), alike=False
    )


def _difference(trial: Trial, other: Trial, middle: Trial) -> Float64:
    """Return the numbers (2, 11) of the cameras of a trial less those of another.

    Rotations are to first order, translations for structures as large as those of `middle`.
    """
    ours, theirs = trial.cameras.rig, other.cameras.rig
    numbers = np.zeros((2, CAMERA))
    numbers[:, 0] = ours.log_focals - theirs.log_focals
    numbers[:, 1:3] = ours.centres - theirs.centres
    numbers[:, 3:LENS] = ours.radial - theirs.radial
    turns = [rig.rotations[1] @ rig.rotations[0].T for rig in (ours, theirs)]
    turn = turns[0] @ turns[1].T
    skew = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    numbers[1, LENS : LENS + 3] = np.array(skew) / 2
    size = _radius(middle.shown.points)
    shifts = [
        size / _radius(each.shown.points) * (rig.translations[1] - turned @ rig.translations[0])
        for each, rig, turned in zip((trial, other), (ours, theirs), turns, strict=True)
    ]
    numbers[1, LENS + 3 :] = shifts[0] - shifts[1]
    return numbers


def _radius(points: Float64) -> float:
    """Median over frames of the size of structures (N, P, 3)."""
    centres = np.nanmedian(points, 1, keepdims=True)
    return float(np.nanmedian(np.linalg.norm(points - centres, axis=-1)))


def _settled(
    problem: CalibrationProblem, found: StaticRig, sight: _Sight, peak: _Peak
) -> Steps[StaticRig]:
    """Set the cameras to the focal lengths of the peak, combined with the prior of lenses."""
    information = FROM_LOGS.T @ peak.information @ FROM_LOGS
    likelihood = FocalLikelihood(information, FROM_LOGS.T @ peak.vector)
    found = found._replace(focals=likelihood)
    logs, covariance = _believed(problem, found, np.log(sight.beliefs.focals))
    last = yield from _tried(sight, FROM_LOGS @ logs, peak.trial.cameras)
    beliefs = _held(sight.beliefs, logs)
    cameras = last.cameras
    deviations = certainty_of(cameras, sight.points, beliefs, sight.clusters).deviations
    # Shapes bend in more ways than models of them do, so even clear keypoints leave an error.
    of_lenses = FROM_LOGS @ (covariance + LEAST_DEVIATION**2 * np.eye(2)) @ FROM_LOGS.T
    variances = np.einsum("ikn,ij,jkn->kn", peak.moves, of_lenses, peak.moves)
    images, _ = straight_images(problem, problem.keypoints)
    points = robust_structures(cameras.rig, images, problem.weights, cameras.noise)
    return found._replace(
        best=StaticScene(cameras.rig, points),
        noise=float(np.median(cameras.noise)),
        deviations=np.sqrt(np.square(deviations) + variances),
    )


def _believed(
    problem: CalibrationProblem, found: StaticRig, expected: Float64
) -> tuple[Float64, Float64]:
    """Return the posterior of the log focal lengths: mean (2,) and covariance.

    One kind of lens is a priori as likely as two; undecided, the covariance spans both answers. It
    is wider where lenses are far off the usual ones: then it is likelier that shapes mislead.
    """
    chosen = lens_kinds(problem, found)
    kinds = [np.zeros(2, np.int64), np.arange(2)] if problem.cameras_alike == "auto" else [chosen]
    priors = [group_covariance(groups, *FOCAL_SDS) for groups in kinds]
    own = group_covariance(chosen, *FOCAL_SDS)
    logs, _ = posterior_of_kinds(found.focals, expected, own)
    information, vector = found.focals
    likeliest = np.linalg.solve(information, vector)
    believed = bagging.reconciled(information, likeliest - expected, np.mean(priors, axis=0))
    doubted = FocalLikelihood(believed, believed @ likeliest)
    return logs, covariance_over_kinds(doubted, expected, priors, logs)
