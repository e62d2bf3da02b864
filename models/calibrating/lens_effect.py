"""How much the uncertainty of the lenses of two static views changes structures.

The focal lengths are moved along the axes of their covariance, with the poses adjusted and the
points located anew. So is each coordinate of a principal point where the size of the image is not
known. What changes beyond a similarity of each frame is the error that follows from the lens. It is
compared with what the noise of the keypoints does to the same points, and with what would be left
if the lenses were known as well as a data sheet has them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import CENTRE_X, CENTRE_Y, FOCAL, points_in_cameras
from models.calibrating.keypoint_rig import LEAST_KNOWN
from models.calibrating.problem import CalibrationProblem, Solution
from models.capture.metrics import procrustes_by_size
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import LEAST_NOISE, adjust_rig
from models.epipolar.rig_search import refocused
from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras, distances_of
from models.findings.finding import Finding
from models.numerics.sampling import evenly_spread
from models.numerics.steps import Steps
from models.optics.lenses.projection import project

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MOVED = [FOCAL, CENTRE_X, CENTRE_Y]  # numbers of a lens that are moved
FRAMES = 40  # at most, that are examined
ITERATIONS = 30  # of adjusting the poses
LEAST_STEP = 0.01  # of a log focal length
HEIGHT = 4.0  # root-mean-square radii: about the height of a person
DATA_SHEET = 0.05  # standard deviation of the log focal length of a lens that is known
TIMES_NOISE = 3.0  # the effect of noise, from which lenses limit the accuracy
SLACK = 0.001  # of the height: smaller errors of structures do not matter


class LensEffect(NamedTuple):
    """Errors of structures: mean distances as shares of the subject's height."""

    by_lenses: float  # for lenses whose numbers are off by a standard deviation each
    by_known: float  # the same if the focal lengths were known to `DATA_SHEET`
    by_noise: float  # of the keypoints


class _Seen(NamedTuple):
    """The keypoints that both views see, as of cameras without distortion."""

    rig: StaticCameras
    points: SeenPoints
    noise: Float64  # (2,) sides
    shown: NDArray[np.bool_]  # (n, P) which keypoints of the frames these are


def lens_findings(
    problem: CalibrationProblem, solution: Solution, deviations: Float64
) -> Steps[tuple[Finding, ...]]:
    """Return a finding if the lenses of two static views limit the accuracy, not the keypoints.

    `deviations` (K, VIEW) are those of the cameras. Of three views or more, errors of lenses come
    from the noise itself, and there is no finding, nor where poses are given.
    """
    unsure = deviations[:, FOCAL] > 0
    pair = len(unsure) == 2 and solution.rig.static.all() and solution.given_poses is None
    if not pair or not unsure.any():
        return ()
    effect = yield from lens_effect(problem, solution, deviations)
    if effect.by_lenses <= TIMES_NOISE * effect.by_noise + SLACK:
        return ()
    posterior = problem.lens_posterior
    peaks = () if posterior is None or len(posterior.peaks) < 2 else posterior.peaks
    views = () if unsure.all() else np.flatnonzero(unsure)
    now, known = (np.hypot(each, effect.by_noise) for each in (effect.by_lenses, effect.by_known))
    evidence = {
        "error_by_lenses_of_height": effect.by_lenses,
        "error_by_noise_of_height": effect.by_noise,
        "error_with_lenses_to_5_percent": float(known),
    }
    for number, peak in enumerate(peaks, 1):
        evidence[f"likely_focal_{number}_in_sides"] = peak
    finding = Finding.of("lenses_limit_accuracy", views=views).with_evidence(evidence)
    gain = (
        f"Lenses known to 5 % would bring the expected error from about {100 * now:.2g} %"
        f" to {100 * known:.2g} % of the subject's height."
    )
    finding = finding.model_copy(update={"remedy": f"{gain} {finding.remedy}"})
    return (finding,)


def lens_effect(
    problem: CalibrationProblem, solution: Solution, deviations: Float64
) -> Steps[LensEffect]:
    """Return what errors of the lenses of two views, and of keypoints, do to structures.

    `deviations` (2, VIEW) are those of the cameras, 0 for a number that was given.
    """
    usable = np.flatnonzero((problem.weights > 0).all(1).sum(1) >= LEAST_KNOWN)
    frames = usable[evenly_spread(len(usable), FRAMES)]
    seen = _seen(problem, solution, frames)
    points = robust_points(seen.rig, seen.points, seen.noise)
    middle = _structures(seen, points)
    centred = middle - np.nanmean(middle, 1, keepdims=True)
    height = HEIGHT * np.nanmedian(np.sqrt(np.nanmean(np.square(centred).sum(-1), 1)))
    covariance = _focal_covariance(problem, deviations)
    changes = []  # for a unit of each log focal length, along the axes of their covariance
    values, axes = np.linalg.eigh(covariance)
    for variance, axis in zip(values, axes.T, strict=True):
        size = max(float(np.sqrt(max(variance, 0.0))), LEAST_STEP)
        step = np.zeros((2, 3))
        step[:, 0] = size * axis
        changes.append((yield from _change(seen, points, middle, step)) / size)
    by_focals = np.tensordot(axes, np.array(changes), 1)  # (2, n, P, 3)
    left = 0.0
    for step in _centre_steps(problem, deviations):
        left += _mean_length((yield from _change(seen, points, middle, step))) ** 2
    precision = np.linalg.pinv(covariance) + np.eye(2) / DATA_SHEET**2
    known = np.where(covariance.any(1), np.linalg.inv(precision), 0.0)
    noisy = procrustes_by_size(_structures(seen, _disturbed(seen, points)), middle)
    return LensEffect(
        float(np.sqrt(_squared(by_focals, covariance) + left) / height),
        float(np.sqrt(_squared(by_focals, known) + left) / height),
        _mean_length(noisy - middle) / height,
    )


def _focal_covariance(problem: CalibrationProblem, deviations: Float64) -> Float64:
    """Return the covariance (2, 2) of the log focal lengths.

    It is that of their posterior, made narrower where constant lengths have told more.
    """
    sds = deviations[:, FOCAL]
    if problem.lens_posterior is None:
        return np.diag(np.square(sds))
    covariance = problem.lens_posterior.covariance
    shares = (sds / np.sqrt(covariance.diagonal())).clip(max=1)
    return np.asarray(covariance * np.outer(shares, shares))


def _squared(changes: Float64, covariance: Float64) -> float:
    """Return the squared error that changes (2, n, P, 3) by two numbers cause, in the mean."""
    return sum(
        float(max(variance, 0.0)) * _mean_length(np.tensordot(axis, changes, 1)) ** 2
        for variance, axis in zip(*_axes(covariance), strict=True)
    )


def _axes(covariance: Float64) -> tuple[Float64, Float64]:
    values, vectors = np.linalg.eigh(covariance)
    return values, vectors.T


def _change(seen: _Seen, points: Float64, middle: Float64, step: Float64) -> Steps[Float64]:
    """Return how structures (n, P, 3) change with a step of the lenses, beyond a similarity."""
    ends = []
    for signed in (step, -step):
        yield
        ends.append(procrustes_by_size(_structures(seen, _moved(seen, points, signed)), middle))
    return (ends[0] - ends[1]) / 2


def _centre_steps(problem: CalibrationProblem, deviations: Float64) -> list[Float64]:
    """Return steps (2, 3) of principal points in sides, one for each coordinate.

    Images of unknown sizes have one guess of their principal points, which is off for both views.
    """
    sds = deviations[:, MOVED] / [1.0, problem.side, problem.side]
    sds[problem.images.known] = 0.0
    steps = [np.where(np.arange(3) == axis, sds, 0.0) for axis in (1, 2)]
    return [step for step in steps if step.any()]


def _seen(problem: CalibrationProblem, solution: Solution, frames: Int64) -> _Seen:
    """Undo the lenses at the estimated points."""
    rig, side = solution.rig, problem.side
    held = points_in_cameras(solution.scene.of(frames), rig)  # (n, 2, P, 3)
    focals = rig.lenses.focals.mean(1)
    straight = focals[:, None, None] * held[..., :2] / held[..., 2:]
    images = (straight + problem.keypoints[frames] - project(held, rig.lenses)) / side
    weights = problem.weights[frames] * np.isfinite(images).all(-1)
    shown = (weights > 0).all(1)  # (n, P)
    none = np.zeros((2, 2))
    return _Seen(
        StaticCameras(np.log(focals / side), none, none, rig.rotations, rig.translations),
        SeenPoints(
            images.transpose(1, 3, 0, 2)[..., shown], weights.transpose(1, 0, 2)[..., shown]
        ),
        np.full(2, max(solution.measured_noise / side, LEAST_NOISE)),
        shown,
    )


def _moved(seen: _Seen, points: Float64, step: Float64) -> Float64:
    """Return the points (3, M) after a step of the lenses, with the poses adjusted.

    The `step` (2, 3) is of log focal lengths, and of principal points in sides.
    """
    rig = refocused(seen.rig, points, seen.rig.log_focals + step[:, 0])
    rig = rig._replace(centres=rig.centres + step[:, 1:])
    none = np.zeros((2, 2))
    held = Beliefs(np.exp(rig.log_focals), none, none, np.zeros((2, 2, 2)), alike=False)
    start = robust_points(rig, seen.points, seen.noise)
    cameras = adjust_rig(rig, start, seen.points, held, iterations=ITERATIONS)
    return robust_points(cameras.rig, seen.points, cameras.noise)


def _disturbed(seen: _Seen, points: Float64) -> Float64:
    """Return the points (3, M) with as much noise again.

    Of the four coordinates of a point three are fitted, so the distance that is left is distributed
    as the error of one coordinate.
    """
    rng, (images, weights) = np.random.default_rng(0), seen.points
    left = np.sqrt(np.square(distances_of(seen.rig, points, seen.points)).sum(0))
    errors = rng.choice(left, images.shape) * rng.choice([-1, 1], images.shape)
    return robust_points(seen.rig, SeenPoints(images + errors, weights), seen.noise)


def _structures(seen: _Seen, points: Float64) -> Float64:
    """Arrange points (3, M) as structures (n, P, 3), NaN where they are not seen."""
    structures = np.full((*seen.shown.shape, 3), np.nan)
    structures[seen.shown] = points.T
    return structures


def _mean_length(changes: Float64) -> float:
    return float(np.nanmean(np.linalg.norm(changes, axis=-1)))
