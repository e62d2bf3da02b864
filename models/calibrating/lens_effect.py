"""How much the uncertainty of the lenses of two static views changes structures.

The focal lengths are moved along the axes of their covariance, with the poses adjusted and the
points located anew. So is each coordinate of a principal point where the size of the image is not
known. What changes beyond a similarity of each frame is the error that follows from the lens.
Lengths within the subject that stay constant limit it. It is compared with what the noise of the
keypoints does to the same points, and with what would be left if the lenses were known as well as a
data sheet has them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.bone_lengths import LEAST_SCATTER, UNKNOWN, BoneLengths, find_bone_lengths
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

# Figures: evidence/lenses.md.
MOVED = [FOCAL, CENTRE_X, CENTRE_Y]  # numbers of a lens that are moved
FRAMES = 40  # at most, that are examined
ITERATIONS = 30  # of adjusting the poses
LEAST_STEP = 1e-4  # of a log focal length: less is exact
STRAY = 0.9  # quantile of changes and scatters of lengths, beyond which they count as no larger
STEADIEST = 1e-4  # of a log length: none is known to be steadier
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
    steps, known = _steps(problem, deviations)
    by_steps = np.empty((len(steps), *middle.shape))  # (F, n, P, 3)
    for place, step in enumerate(steps):
        by_steps[place] = yield from _change(seen, points, middle, step)
    bones = find_bone_lengths(solution.scene.points, problem.measured)
    contradicted = _contradicted(bones._replace(measured=bones.measured[frames]), middle, by_steps)
    noisy = procrustes_by_size(_structures(seen, _disturbed(seen, points)), middle)
    unknown = np.eye(len(steps))
    return LensEffect(
        _mean_error(by_steps, unknown, contradicted) / height,
        _mean_error(by_steps, known, contradicted) / height,
        _mean_length(noisy - middle) / height,
    )


def _steps(problem: CalibrationProblem, deviations: Float64) -> tuple[list[Float64], Float64]:
    """Return independent steps (2, 3) of log focal lengths, and of principal points in sides.

    Each is a standard deviation long. Their covariance (F, F) would be the second value if the
    focal lengths were known to `DATA_SHEET`. Images of unknown sizes have one guess of their
    principal points, which is off for both views.
    """
    covariance = _focal_covariance(problem, deviations)
    values, axes = np.linalg.eigh(covariance)
    roots = np.sqrt(values.clip(0))
    some = roots > LEAST_STEP
    steps = [
        np.outer(root * axis, [1.0, 0.0, 0.0]) for root, axis in zip(roots, axes.T, strict=True)
    ]
    focals = axes[:, some] * roots[some]
    narrowed = np.linalg.inv(np.eye(some.sum()) + focals.T @ focals / DATA_SHEET**2)
    sds = deviations[:, MOVED] / [1.0, problem.side, problem.side]
    sds[problem.images.known] = 0.0
    centres = [np.where(np.arange(3) == axis, sds, 0.0) for axis in (1, 2)]
    centres = [step for step in centres if step.any()]
    known = np.eye(some.sum() + len(centres))
    known[: some.sum(), : some.sum()] = narrowed
    return [step for step, used in zip(steps, some, strict=True) if used] + centres, known


def _focal_covariance(problem: CalibrationProblem, deviations: Float64) -> Float64:
    """Return the covariance (2, 2) of the log focal lengths.

    It is that of their posterior, if they have one.
    """
    posterior = problem.lens_posterior
    if posterior is None:
        return np.diag(np.square(deviations[:, FOCAL]))
    return posterior.covariance


def _contradicted(bones: BoneLengths, middle: Float64, by_steps: Float64) -> Float64:
    """Return the information (F, F) of lengths that stay constant on steps of the lenses.

    The scatter that steps cause in them is held against the scatter that there is, as a single
    observation: errors of lengths repeat in all frames and bones.
    """
    known = bones.measured & (bones.scatter < UNKNOWN)
    if not known.any() or not len(by_steps):
        return np.zeros((len(by_steps), len(by_steps)))
    ends = np.nan_to_num(np.stack((middle + by_steps, middle - by_steps), 1))
    offsets = np.array([[bones.offsets(end) for end in each] for each in ends])
    changes = (offsets[:, 0] - offsets[:, 1])[:, known] / 2  # (F, n)
    most = np.quantile(np.abs(changes), STRAY, axis=1, keepdims=True)
    changes = changes.clip(-most, most)
    scatter = np.broadcast_to(bones.scatter, known.shape)[known]
    squared = np.square(scatter.clip(max=np.quantile(scatter, STRAY))) - LEAST_SCATTER**2
    among = changes @ changes.T / changes.shape[1]
    return np.asarray(among / max(float(squared.mean()), STEADIEST**2))


def _mean_error(by_steps: Float64, covariance: Float64, contradicted: Float64) -> float:
    """Return the mean error that steps with a covariance (F, F) cause, as lengths allow them."""
    allowed = np.asarray(np.linalg.inv(np.linalg.inv(covariance) + contradicted), np.float64)
    squares = [
        variance * _mean_length(np.tensordot(axis, by_steps, 1)) ** 2
        for variance, axis in zip(*_axes(allowed), strict=True)
    ]
    return float(np.sqrt(sum(squares)))


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
