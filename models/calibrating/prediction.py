"""Prediction of hidden keypoints, in frames that a solution was not learnt from."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Scene, make_shape_prior
from models.bundle.scene_adjustment import adjust_frames, costs_of
from models.bundle.shape_model import align
from models.calibrating.expectation_maximisation import regauge
from models.calibrating.problem import CalibrationProblem, Solution, reprojection_distances
from models.settings.keypoints import MIN_KEYPOINTS

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

EVERY = 5  # one frame in so many is left out of learning
MOST_JUDGES = 80  # frames that are left out at most
QUARTERS = 4  # a keypoint is hidden in one of so many rounds
ROUNDS = 2  # of these that are used
ITERATIONS = 15
FREEDOM = 3.0  # of Student's t
RAYLEIGH = 1.1774  # median length of a pair of unit normal numbers
LENS_ERRORS = 1e-3  # of the image's side: errors of lens models, which are ignored
LIKELY = 2.0  # standard errors by which one rig must predict better than another to replace it
WORST = 1e3  # standard deviations that a frame without an explanation counts as


class Split(NamedTuple):
    """Frames to learn from, and held-out frames."""

    learning: Int64
    judging: Int64


def split_frames(frames: int) -> Split:
    """Hold out every fifth frame, at most `MOST_JUDGES`; none if there are very few."""
    if frames < EVERY:
        return Split(np.arange(frames), np.arange(frames))
    judging = np.arange(frames)[EVERY // 2 :: EVERY]
    judging = judging[:: -(-len(judging) // MOST_JUDGES)]
    return Split(np.setdiff1d(np.arange(frames), judging), judging)


def predicted_distances(problem: CalibrationProblem, learnt: Solution, start: Scene) -> Float64:
    """Return distances (N, K, P) in pixels from hidden keypoints to their prediction; NaN if none.

    Every frame of the problem is adjusted from `start`, with the learnt rig, shapes and noise, to
    three quarters of the keypoints of every view.
    """
    rig, shapes = learnt.rig, learnt.shapes
    points, similarity = align(start.points, shapes.mean)
    start = regauge(start, points, similarity, rig)
    prior = make_shape_prior(np.tile(shapes.mean, (len(points), 1, 1)), shapes.basis, shapes.spread)
    views = problem.views(learnt.noise)
    # A structure from noisy rays may reach behind a camera; then the mean structure is the start.
    behind = ~np.isfinite(costs_of(views, rig, prior, start))
    start = start._replace(points=np.where(behind[:, None, None], shapes.mean, start.points))
    seen = problem.weights > 0
    quarter = np.random.default_rng(0).integers(QUARTERS, size=seen.shape)
    distances = np.full(seen.shape, np.nan)
    for number in range(ROUNDS):
        hidden = seen & (quarter == number)
        # A view that would be left with too few keypoints is not predicted.
        hidden &= ((seen & ~hidden).sum(-1) >= MIN_KEYPOINTS)[..., None]
        scene, costs = adjust_frames(
            views._replace(weights=views.weights * ~hidden),
            rig,
            prior,
            start,
            iterations=ITERATIONS,
        )
        off = reprojection_distances(problem, rig, scene)
        off[~np.isfinite(costs)] = WORST * problem.side
        distances[hidden] = off[hidden]
    return distances


def predicts_better(asked: CalibrationProblem, first: Float64, other: Float64) -> bool:
    """Whether the `other` distances (N, K, P) are better than the first ones beyond chance."""
    noise = common_noise([first, other], asked.side)
    gain = surprise(first, asked.weights, noise) - surprise(other, asked.weights, noise)
    known = gain[np.isfinite(gain)]
    if not len(known):
        return False
    chance = float(known.std()) / math.sqrt(len(known))
    return bool(known.mean() > LIKELY * chance)


def typical_distance(distances: Float64) -> float:
    """Return the median in pixels of distances (N, K, P); NaN where there is no prediction."""
    asked = distances[np.isfinite(distances)]
    return float(np.median(asked)) if len(asked) else math.nan


def common_noise(distances: list[Float64], side: float) -> float:
    """Return the noise in pixels under which predictions (N, K, P) are compared: the best one's."""
    least = min(typical_distance(each) for each in distances)
    return math.hypot(least / RAYLEIGH, LENS_ERRORS * side)


def surprise(distances: Float64, weights: Float64, noise: float) -> Float64:
    """Return minus log likelihoods of distances under Student's t; means (N, K), NaN without any.

    Every view of a frame counts once, because its keypoints are not independent.
    """
    asked = np.isfinite(distances)
    off = np.where(asked, distances, 0.0).clip(max=WORST * noise)
    costs = (FREEDOM + 2) / 2 * np.log1p(np.square(off / noise) / FREEDOM)
    counts = (weights * asked).sum(-1)
    with np.errstate(invalid="ignore"):
        means: Float64 = (costs * weights * asked).sum(-1) / counts
    return means
