"""Static cameras and structures from keypoints alone, by robust structure from motion.

For static cameras, every keypoint of every frame is a point of one rigid scene. Pairs of views
give relative poses (`pairs`), which are assembled to rigs (`assembly`). The best rigs are adjusted
(`rig_adjustment`). Neither a network nor shapes are used. All starts, among them the mirror image
(Necker's reversal) of the best, are compared under one common noise.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.assembly import ViewGraph
from models.epipolar.camera_motion import CameraMotion, camera_motion
from models.epipolar.pairs import Beliefs
from models.epipolar.rig_adjustment import AdjustedRig, adjust_rig
from models.epipolar.rig_certainty import Certainty, FocalLikelihood, certainty_of
from models.epipolar.rig_search import finished_rig, likely_rigs, necker, ordered, same_rig
from models.epipolar.robust_points import costs_of, robust_points
from models.epipolar.static_cameras import (
    CAMERA,
    SeenPoints,
    StaticCameras,
    distances_of,
)
from models.epipolar.view_graph import (
    NO_RIG,
    NOISY_POINTS,
    SharedPoints,
    moving_pairs,
    relate_pairs,
    tied_views,
)
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FEW_POINTS, NOISY_OBSERVATIONS = 900, 24000  # to choose among starts, and at the end
MOST_FRAMES = 300  # used to test whether cameras move
LAST_ITERATIONS = 25
# Observations never count as more than so many over the square of the noise, as a share of the
# subject's size: adjusting points with noisy rays biases cameras (Neyman & Scott, 1948), and the
# bias, unlike the scatter, does not fall with their number.
UNBIASED = 40.0
OUT_OF_LINE = 3.0  # times the noise that views share: a view beyond it is not static with them
MOVES = 0.03  # of the subject's size in the image: a camera whose motion shifts it less is static
MOVES_OF_TWO = 0.15  # the same of two views, where errors that repeat look like motion
ACCOUNTED = 0.02  # of the subject's size: share of the residuals that is motion, for it to matter
SURE = 3.0  # standard errors by which a pose of its own must predict keypoints better


class StaticScene(NamedTuple):
    """Static cameras and the points that they see."""

    rig: StaticCameras  # K cameras in sides; the poses of views that are not static are NaN
    points: Float64  # (N, P, 3) in the rig's frame, NaN where fewer than two of these views see


class StaticRig(NamedTuple):
    """Static cameras, as estimated from keypoints alone."""

    best: StaticScene
    mirror: StaticScene  # the best of the other handedness
    static: Bool  # (K,) which views are static
    noise: float  # sides
    log_odds: Float64  # (N,) of each frame, for the best and against its mirror image
    focals: FocalLikelihood  # of the static views
    deviations: (
        Float64  # (K, 11) of `StaticCameras`'s numbers, infinite of views that are not static
    )
    motion: CameraMotion  # of the static views

    def mirrored(self) -> "StaticRig":
        """Return the rig with the other handedness as the best."""
        return self._replace(best=self.mirror, mirror=self.best, log_odds=-self.log_odds)

    def of(self, frames: NDArray[np.int64]) -> "StaticRig":
        """Return the rig with the structures of some of the frames."""
        return self._replace(
            best=self.best._replace(points=self.best.points[frames]),
            mirror=self.mirror._replace(points=self.mirror.points[frames]),
            log_odds=self.log_odds[frames],
        )


class Geometry(NamedTuple):
    """What keypoints alone show of all cameras together."""

    rig: StaticRig | None  # None: no two static cameras explain them
    graph: ViewGraph  # relative poses of pairs of views
    moves: bool  # whether two of the cameras certainly move relative to each other

    def of(self, frames: NDArray[np.int64]) -> "Geometry":
        """Return the geometry with the structures of some of the frames."""
        return self._replace(rig=self.rig and self.rig.of(frames))


def find_static_rig(
    images: Float64,
    weights: Float64,
    beliefs: Beliefs,
    sizes: Float64,
    *,
    declared: bool = False,
    graph: ViewGraph | None = None,
    seed: int = 0,
) -> Steps[Geometry]:
    """Find static cameras from the keypoints of N frames; yields now and then, to be stopped.

    Parameters
    ----------
    images
        (N, K, P, 2) keypoints from the expected principal points, in sides of the image; without
        distortion where the lens was given.
    weights
        (N, K, P) confidences, 0 where not observed.
    sizes
        (K,) sides, root-mean-square radius of the subject in each view.
    declared
        Whether all views are declared static; otherwise those that move are left out.
    graph
        The relative poses of pairs of views, if they are known.

    Returns
    -------
    The geometry, without a rig if no two views share enough, or if static cameras do not explain
    the keypoints.
    """
    rng = np.random.default_rng(seed)
    scene = SharedPoints.of(images, weights, rng)
    if graph is None:
        graph = yield from relate_pairs(scene, beliefs, rng)
    moving = moving_pairs(scene, graph, sizes)
    if declared:
        members = list(range(len(sizes)))
    else:
        graph_of_static = {pair: poses for pair, poses in graph.items() if pair not in moving}
        members = tied_views(graph_of_static, sizes)
    found = Geometry(None, graph, bool(moving))
    while len(members) > 1:
        chosen = yield from _adjusted(graph, scene, beliefs, sizes, members)
        if chosen is None:
            return found
        out = None if declared else _out_of_line(chosen.noise_alone, sizes[members])
        if out is None:
            result = _result(chosen, images, weights, beliefs, sizes, members)
            out = _most_moving(result.motion, chosen.adjusted.noise, sizes[members])
            if out is None or declared:
                return found._replace(rig=result)
            found = found._replace(moves=True)
        members = [view for place, view in enumerate(members) if place != out]
    return found


class _Chosen(NamedTuple):
    adjusted: AdjustedRig
    mirror: AdjustedRig
    noise_alone: Float64  # (K,) sides, of each view separately
    certainty: Certainty


def _adjusted(
    graph: ViewGraph, scene: SharedPoints, beliefs: Beliefs, sizes: Float64, members: list[int]
) -> Steps[_Chosen | None]:
    """Assemble the views in several ways and adjust the best; None if they do not connect."""
    place = {view: i for i, view in enumerate(members)}
    graph = {
        (place[a], place[b]): poses for (a, b), poses in graph.items() if {a, b} <= set(members)
    }
    of_members = beliefs.of(members)
    few = scene.seen(members, FEW_POINTS)
    likely = yield from likely_rigs(graph, few, of_members, sizes[members])
    if not likely:
        return None
    count = min(NOISY_POINTS, NOISY_OBSERVATIONS // len(members))
    many = scene.seen(members, count)
    rivals = []
    for each in likely:
        yield
        rivals.append(finished_rig(each, many, of_members, iterations=LAST_ITERATIONS))
    best = ordered(rivals, many, of_members)[0]
    noise = float(np.median(best.noise)) / float(sizes[members].mean())
    share = min(1.0, UNBIASED / noise**2 / many.weights.sum())
    if share < 1:
        yield
        many = many._replace(weights=share * many.weights)
        best = finished_rig(best, many, of_members, iterations=LAST_ITERATIONS)
    yield
    twin_start = necker(best.rig, best.points)
    twin = adjust_rig(*twin_start, many, of_members, iterations=LAST_ITERATIONS)
    if same_rig(twin.rig, best.rig):  # the mirror image is not a second optimum
        twin = best._replace(rig=twin_start[0], points=twin_start[1])
    best, twin = ordered([best, twin], many, of_members)
    distances = distances_of(best.rig, best.points, many)
    alone = np.array(
        [np.median(row[w > 0]) for row, w in zip(distances, many.weights, strict=True)]
    )
    chosen = scene.chosen(members, count)
    clusters = (scene.frames[chosen], scene.keypoints[chosen])
    return _Chosen(best, twin, alone, certainty_of(best, many, of_members, clusters))


def _most_moving(motion: CameraMotion, noise: Float64, sizes: Float64) -> int | None:
    """Return the camera whose own poses predict keypoints best; None if no camera moves.

    The motion must matter: it shifts the subject by a share of its size (K,), or accounts for a
    share of the residuals of static cameras, which have the `noise` (K,).
    """
    least = MOVES if len(sizes) > 2 else MOVES_OF_TWO
    matters = motion.squares > np.square(least * sizes)
    matters |= 2 * motion.gains * np.square(noise) > np.square(ACCOUNTED * sizes)
    moves = (motion.gains > SURE * motion.errors) & matters
    if not moves.any():
        return None
    return int(np.where(moves, motion.gains, 0.0).argmax())


def _out_of_line(alone: Float64, sizes: Float64) -> int | None:
    """Return the view that is not static with the others, if there is one."""
    relative = alone / sizes
    worst = int(relative.argmax())
    common = float(np.sort(alone)[(len(alone) - 1) // 2])
    beyond = len(alone) > 2 and alone[worst] > OUT_OF_LINE * max(common, 1e-3)
    return worst if beyond or relative[worst] > NO_RIG else None


def _result(
    chosen: _Chosen,
    images: Float64,
    weights: Float64,
    beliefs: Beliefs,
    sizes: Float64,
    members: list[int],
) -> StaticRig:
    """Triangulate every frame in both handednesses, and compute the log odds of each frame."""
    frames, views, keypoints, _ = images.shape
    static = np.zeros(views, bool)
    static[members] = True
    every = SeenPoints(
        images[:, members].transpose(1, 3, 0, 2).reshape(len(members), 2, -1),
        weights[:, members].transpose(1, 0, 2).reshape(len(members), -1),
    )
    known = np.flatnonzero((every.weights > 0).sum(0) >= 2)
    some = SeenPoints(every.images[..., known], every.weights[:, known])
    noise = chosen.adjusted.noise
    explanations, costs, located = [], [], []
    for rig in (chosen.adjusted.rig, chosen.mirror.rig):
        found = robust_points(rig, some, noise)
        points = np.full((frames * keypoints, 3), np.nan)
        points[known] = found.T
        whole = _of_all_views(rig, beliefs, members)
        explanations.append(StaticScene(whole, points.reshape(frames, keypoints, 3)))
        located.append(found)
        robust = costs_of(rig, found, some, noise)
        costs.append(np.bincount(known // keypoints, robust, frames))
    best, mirror = explanations
    odds = np.asarray(costs[1] - costs[0], np.float64)
    deviations = np.full((views, CAMERA), np.inf)
    deviations[members] = chosen.certainty.deviations
    of_frames = known // keypoints
    asked = np.flatnonzero(of_frames % math.ceil(frames / MOST_FRAMES) == 0)
    motion = camera_motion(
        chosen.adjusted.rig,
        located[0][:, asked],
        SeenPoints(some.images[..., asked], some.weights[:, asked]),
        noise,
        of_frames[asked],
        sizes[members],
    )
    return StaticRig(
        best,
        mirror,
        static,
        float(np.median(noise)),
        odds,
        chosen.certainty.focals,
        deviations,
        motion,
    )


def _of_all_views(rig: StaticCameras, beliefs: Beliefs, members: list[int]) -> StaticCameras:
    """Return the cameras of some views as an array over all views."""
    views = len(beliefs.focals)
    whole = StaticCameras(
        np.log(beliefs.focals),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.full((views, 3, 3), np.nan),
        np.full((views, 3), np.nan),
    )
    for array, row in zip(whole, rig, strict=True):
        array[members] = row
    return whole
