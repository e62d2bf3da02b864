"""Two static cameras at the posterior mean of their focal lengths."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import FOCAL
from models.calibrating.keypoint_rig import straight_images
from models.calibrating.lens_evidence import with_shapes
from models.calibrating.lens_posterior import posterior_of
from models.calibrating.lens_profile import FROM_LOGS, Pair, Walk, kinds_of, pair_of, walk_lenses
from models.calibrating.problem import CalibrationProblem
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig
from models.epipolar.rig_certainty import certainty_of
from models.epipolar.rig_search import refocused
from models.epipolar.robust_points import robust_points, robust_structures
from models.epipolar.static_cameras import CAMERA, LENS, SeenPoints, StaticCameras
from models.epipolar.static_rig import StaticRig, StaticScene
from models.epipolar.view_graph import NOISY_POINTS, SharedPoints
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

ITERATIONS = 30  # of adjusting cameras
LEAST_STEP, MOST_STEP = 0.01, 0.2  # of a log focal length, to differentiate cameras by it


def settle_lenses(
    problem: CalibrationProblem, found: StaticRig
) -> Steps[tuple[CalibrationProblem, StaticRig]]:
    """Return the problem with the posterior of two lenses, and the cameras at its mean.

    `found` are the cameras from geometry alone, and their handedness. Both stay as they are if
    there are three views or more, or if both focal lengths are held.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where no cameras are determined.
    """
    if found.static.tolist() != [True, True] or not problem.lens_sds[:, FOCAL].any():
        return problem, found
    pair = pair_of(problem, found)
    walks = yield from with_shapes(pair, (yield from walk_lenses(pair, kinds_of(problem))))
    posterior = posterior_of(walks)
    images, _ = straight_images(problem, problem.keypoints)
    shared = SharedPoints.of(images, problem.weights, np.random.default_rng(0))
    seen, chosen = shared.seen([0, 1], NOISY_POINTS), shared.chosen([0, 1], NOISY_POINTS)
    near = _nearest(pair, walks, posterior.mean)
    yield
    cameras, held = _held(seen, near, posterior.mean, pair.beliefs)
    clusters = (shared.frames[chosen], shared.keypoints[chosen])
    squares = np.square(certainty_of(cameras, seen, held, clusters).deviations)
    for variance, axis in zip(*np.linalg.eigh(posterior.covariance), strict=True):
        step = float(np.sqrt(max(variance, 0.0)).clip(LEAST_STEP, MOST_STEP))
        yield
        moved, _ = _held(seen, cameras, posterior.mean + step * axis, pair.beliefs)
        squares += max(variance, 0.0) * np.square(_difference(moved, cameras) / step)
    points = robust_structures(cameras.rig, images, problem.weights, cameras.noise)
    lenses = problem.reference.lenses
    focals = np.where(
        problem.lens_sds[:, [FOCAL]] > 0,
        problem.side * np.exp(posterior.mean)[:, None] * lenses.focals
        / lenses.focals.mean(1, keepdims=True),
        lenses.focals,
    )  # fmt: skip
    reference = problem.reference._replace(lenses=lenses._replace(focals=focals))
    settled = found._replace(
        best=StaticScene(cameras.rig, points),
        noise=float(np.median(cameras.noise)),
        deviations=np.sqrt(squares),
    )
    return problem._replace(reference=reference, lens_posterior=posterior), settled


def _nearest(pair: Pair, walks: list[Walk], log_focals: Float64) -> AdjustedRig:
    """Return the cameras of the place nearest to two log focal lengths."""
    places = [place for walk in walks for place in (*walk.places, *walk.aside)]
    at = FROM_LOGS @ log_focals
    return min(places, key=lambda place: float(np.square(place.at - at).sum())).cameras


def _held(
    seen: SeenPoints, near: AdjustedRig, log_focals: Float64, beliefs: Beliefs
) -> tuple[AdjustedRig, Beliefs]:
    """Adjust cameras with both focal lengths held, from others."""
    start = robust_points(near.rig, seen, near.noise)
    rig = refocused(near.rig, start, log_focals)
    held = replace(
        beliefs, focals=np.exp(log_focals), focal_covariance=np.zeros((2, 2)), alike=False
    )
    points = robust_points(rig, seen, near.noise)
    return adjust_rig(rig, points, seen, held, iterations=ITERATIONS), held


def _difference(moved: AdjustedRig, middle: AdjustedRig) -> Float64:
    """Return the numbers (2, 11) of cameras less those of others, relative to the first camera.

    Rotations are to first order, translations for points as far spread as those of `middle`.
    """
    ours, theirs = moved.rig, middle.rig
    numbers = np.zeros((2, CAMERA))
    numbers[:, 0] = ours.log_focals - theirs.log_focals
    numbers[:, 1:3] = ours.centres - theirs.centres
    numbers[:, 3:LENS] = ours.radial - theirs.radial
    turns = [rig.rotations[1] @ rig.rotations[0].T for rig in (ours, theirs)]
    turn = turns[0] @ turns[1].T
    skew = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    numbers[1, LENS : LENS + 3] = np.array(skew) / 2
    size = _spread(middle.points) / _spread(moved.points)
    shifts = [_shift(rig, turned) for rig, turned in zip((ours, theirs), turns, strict=True)]
    numbers[1, LENS + 3 :] = size * shifts[0] - shifts[1]
    return numbers


def _shift(rig: StaticCameras, turned: Float64) -> Float64:
    """Return the translation from the first camera to the second."""
    return np.asarray(rig.translations[1] - turned @ rig.translations[0])


def _spread(points: Float64) -> float:
    """Median distance of points (3, M) from their middle."""
    return float(np.median(np.linalg.norm(points - np.median(points, 1, keepdims=True), axis=0)))
