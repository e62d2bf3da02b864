"""Cameras at rest and structures from keypoints alone, by robust structure from motion.

For cameras at rest, every keypoint of every frame is a point of one rigid scene. Pairs of views
give relative poses (`pairs`), these are put together to rigs (`assembly`), and the best are
adjusted (`rig_adjustment`). No network and no shapes take part. All starts, among them the mirror
image (Necker's reversal) of the best, are compared under one common noise.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.assembly import ViewGraph, assemble
from models.epipolar.camera_motion import CameraMotion, camera_motion
from models.epipolar.pairs import Beliefs, relate
from models.epipolar.rig_adjustment import Adjusted, adjust_rig, prior_cost
from models.epipolar.rig_certainty import (
    Certainty,
    FocalLikelihood,
    certainty_of,
)
from models.epipolar.robust_points import robust_points, triangulate_points
from models.epipolar.static_cameras import CAMERA, Rigid, Seen, distances_of, robust_costs
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MOST_POINTS, FEW_POINTS = 3000, 900  # that are adjusted at the end, and to choose among starts
NOISY_POINTS, NOISY_OBSERVATIONS = 9000, 24000
MOST_FRAMES = 300  # that are asked whether cameras move
MOST_PAIRS = 18  # of views that are related
STARTS, FINALISTS = 6, 2
OTHER_FOCALS, SWEEPS, SWEEP_ITERATIONS = (0.5, 2.0), 2, 6
FIRST_ITERATIONS, MORE_ITERATIONS, LAST_ITERATIONS = 15, 20, 25
SAME = 0.03  # radians and share of focal lengths within which rigs count as one
LEAST_POINTS = 60  # seen by a view together with others, for it to take part
# Observations never say more than so many, over the square of the noise as a share of the subject's
# size, would: adjusting points with noisy rays biases cameras (Neyman & Scott, 1948), and the bias,
# unlike the scatter, does not fall with their number.
UNBIASED = 40.0
# A first adjustment believes no noise below this share of the subject's size, nor needs it less
# than lens models leave, in sides.
FIRST_NOISE, LENS_NOISE = 0.02, 1e-3
COOLING = (1.0, 0.03)  # of it, one after another
OUT_OF_LINE = 3.0  # times the noise that views share: a view beyond it does not rest with them
UNLIKE_PAIRS = 5.0  # times the noise of the best pair: a pair beyond it does not rest
NO_RIG = 0.3  # noise, as a share of a view's size, that says that nothing rests


class Explanation(NamedTuple):
    """Cameras at rest, and what they see."""

    rig: Rigid  # K cameras in sides; of views that take no part the pose is NaN
    points: Float64  # (N, P, 3) in the rig's frame, NaN where fewer than two of these views see


class RestingRig(NamedTuple):
    """Cameras that rest, as far as keypoints alone say."""

    best: Explanation
    mirror: Explanation  # the best that there is of the other hand
    resting: Bool  # (K,) which views take part
    noise: float  # sides
    log_odds: Float64  # (N,) what each frame says for the best and against its mirror image
    focals: FocalLikelihood  # what keypoints say of the focal lengths of the views that rest
    deviations: Float64  # (K, 11) of `Rigid`'s numbers, infinite of views that do not rest
    motion: CameraMotion  # of the views that rest, as far as they do


def find_resting_rig(
    images: Float64, weights: Float64, beliefs: Beliefs, sizes: Float64, *, seed: int = 0
) -> Steps[RestingRig | None]:
    """Find cameras at rest from what they see of N frames; yields now and then, to be stopped.

    Parameters
    ----------
    images
        (N, K, P, 2) keypoints from the expected principal points, in sides of the image; without
        distortion where the lens was told.
    weights
        (N, K, P) confidences, 0 where not observed.
    sizes
        (K,) sides, root-mean-square radius of the subject in each view.

    Returns
    -------
    None if no two views share enough, or nothing that rests explains what they see.
    """
    rng = np.random.default_rng(seed)
    scene = _Scene.of(images, weights, rng)
    graph = yield from _relate_pairs(scene, beliefs, rng)
    members = _members(graph, sizes)
    while len(members) > 1:
        chosen = yield from _adjusted(graph, scene, beliefs, sizes, members)
        if chosen is None:
            return None
        out = _out_of_line(chosen.noise_alone, sizes[members])
        if out is None:
            return _result(chosen, images, weights, beliefs, members)
        members = [view for place, view in enumerate(members) if place != out]
        graph = {pair: poses for pair, poses in graph.items() if set(pair) <= set(members)}
    return None


def necker(rig: Rigid, points: Float64) -> tuple[Rigid, Float64]:
    """Return the mirror image of cameras and points (3, M), which distant cameras see alike."""
    centre = np.median(points, 1)
    flip = np.diag([1.0, 1.0, -1.0])
    translations = rig.translations + rig.rotations @ centre
    mirrored = rig._replace(rotations=flip @ rig.rotations @ flip, translations=translations)
    return mirrored, flip @ (points - centre[:, None])


class _Scene(NamedTuple):
    """All (frame, keypoint) that two views or more see, as points, and a sample of them."""

    frames: NDArray[np.int64]  # (M,)
    keypoints: NDArray[np.int64]  # (M,)
    images: Float64  # (K, 2, M)
    weights: Float64  # (K, M)
    sample: NDArray[np.int64]  # places of at most `NOISY_POINTS` of them, in no order

    @classmethod
    def of(cls, images: Float64, weights: Float64, rng: np.random.Generator) -> "_Scene":
        frames, keypoints = np.nonzero((weights > 0).sum(1) >= 2)
        order = rng.permutation(len(frames))
        # Points that many views see come first: they tie the views together.
        seen = (weights > 0).sum(1)[frames, keypoints][order]
        order = order[np.argsort(-np.minimum(seen, 3), kind="stable")]
        return cls(
            frames,
            keypoints,
            images[frames, :, keypoints].transpose(1, 2, 0),
            weights[frames, :, keypoints].T,
            order[:NOISY_POINTS],
        )

    def seen(self, members: list[int], most: int) -> Seen:
        """Return what some views see of at most so many points of the sample."""
        points = self.chosen(members, most)
        return Seen(self.images[members][..., points], self.weights[members][:, points])

    def chosen(self, members: list[int], most: int) -> NDArray[np.int64]:
        """Return the places of these points."""
        several = np.flatnonzero((self.weights[members][:, self.sample] > 0).sum(0) >= 2)
        return self.sample[several[:most]]


class _Chosen(NamedTuple):
    adjusted: Adjusted
    mirror: Adjusted
    noise_alone: Float64  # (K,) sides, of each view by itself
    certainty: Certainty


def _relate_pairs(scene: _Scene, beliefs: Beliefs, rng: np.random.Generator) -> Steps[ViewGraph]:
    """Find the relative poses of pairs; of many views those that share most, and all are tied."""
    views = len(scene.weights)
    there = (scene.weights > 0).astype(float)
    shared = there @ there.T
    pairs = sorted(combinations(range(views), 2), key=lambda pair: -shared[pair])
    graph: ViewGraph = {}
    for pair in _chosen_pairs(pairs, views):
        yield
        first, second = pair
        both = np.flatnonzero((there[first] > 0) & (there[second] > 0))
        some = rng.permutation(both)[:MOST_POINTS]
        lenses = list(pair)
        poses = relate(
            scene.images[first][:, some].T,
            scene.images[second][:, some].T,
            beliefs.focals[lenses],
            beliefs.focal_sds[lenses],
            rng,
        )
        if poses is not None:
            graph[pair] = poses
    return graph


def _chosen_pairs(pairs: list[tuple[int, int]], views: int) -> Iterator[tuple[int, int]]:
    """Take the first pairs, such that every view has its share of them."""
    if len(pairs) <= MOST_PAIRS:
        yield from pairs
        return
    most = max(3, 2 * MOST_PAIRS // views)
    count = [0] * views
    for a, b in pairs:
        if (count[a] < most and count[b] < most) or min(count[a], count[b]) == 0:
            count[a], count[b] = count[a] + 1, count[b] + 1
            yield a, b


def _members(graph: ViewGraph, sizes: Float64) -> list[int]:
    """Return the views that pairs tie together whose noise does not rule out that they rest."""
    least = min((poses.noise for poses in graph.values()), default=0.0)
    most = UNLIKE_PAIRS * max(least, LENS_NOISE)
    likely = [
        pair
        for pair, poses in graph.items()
        if poses.noise < min(most, NO_RIG * float(sizes[list(pair)].mean()))
    ]
    label = list(range(len(sizes)))
    for j, k in likely:
        old, new = label[k], label[j]
        label = [new if x == old else x for x in label]
    largest = max(set(label), key=label.count)
    return [k for k in range(len(sizes)) if label[k] == largest]


def _adjusted(
    graph: ViewGraph, scene: _Scene, beliefs: Beliefs, sizes: Float64, members: list[int]
) -> Steps[_Chosen | None]:
    """Put the views together in several ways and adjust the best; None if they do not hang."""
    place = {view: i for i, view in enumerate(members)}
    graph = {
        (place[a], place[b]): poses for (a, b), poses in graph.items() if {a, b} <= set(members)
    }
    of_members = beliefs.of(members)
    few = scene.seen(members, FEW_POINTS)
    noise = float(np.median([poses.noise for poses in graph.values()]))
    rigs = assemble(graph, few, max(noise, 1e-3))
    if not rigs:
        return None
    least = min(LENS_NOISE, FIRST_NOISE * float(np.median(sizes[members])))
    free = replace(of_members, alike=False)
    first = []
    for rig in _distinct([rig.rig for rig in rigs], STARTS):
        yield
        points = triangulate_points(rig, few)
        first.append(
            adjust_rig(
                rig,
                points,
                few,
                free,
                iterations=FIRST_ITERATIONS,
                lenses=False,
                least_noise=least,
            )
        )
    first = _ordered(first, few, free)
    first[0] = yield from _with_other_lenses(first[0], few, free, least)
    second = []
    for adjusted in first[:FINALISTS]:
        rig = adjusted.rig
        alike = rig._replace(
            log_focals=np.where(of_members.focal_sds > 0, np.median(rig.log_focals), rig.log_focals)
        )
        for start in (rig, alike):
            yield
            second.append(_nearer(start, adjusted.points, few, of_members, least))
    mirror = _nearer(*necker(second[0].rig, second[0].points), few, of_members, least)
    finalists = _ordered([*second, mirror], few, of_members)
    yield
    count = min(NOISY_POINTS, NOISY_OBSERVATIONS // len(members))
    many = scene.seen(members, count)
    likely = [finalists[0]]
    likely += [each for each in finalists[1:] if not _same(each.rig, likely[0].rig)][:1]
    rivals = []
    for each in likely:
        yield
        rivals.append(_finished(each, many, of_members, iterations=LAST_ITERATIONS))
    best = _ordered(rivals, many, of_members)[0]
    noise = float(np.median(best.noise)) / float(sizes[members].mean())
    share = min(1.0, UNBIASED / noise**2 / many.weights.sum())
    if share < 1:
        yield
        many = many._replace(weights=share * many.weights)
        best = _finished(best, many, of_members, iterations=LAST_ITERATIONS)
    yield
    twin_start = necker(best.rig, best.points)
    twin = adjust_rig(*twin_start, many, of_members, iterations=LAST_ITERATIONS)
    best, twin = _ordered([best, twin], many, of_members)
    distances = distances_of(best.rig, best.points, many)
    alone = np.array(
        [np.median(row[w > 0]) for row, w in zip(distances, many.weights, strict=True)]
    )
    chosen = scene.chosen(members, count)
    clusters = (scene.frames[chosen], scene.keypoints[chosen])
    return _Chosen(best, twin, alone, certainty_of(best, many, of_members, clusters))


def _with_other_lenses(
    adjusted: Adjusted, seen: Seen, beliefs: Beliefs, least_noise: float
) -> Steps[Adjusted]:
    """Try other focal lengths of one camera after another, each from where it sees things as large.

    A camera that is nearer, with a shorter lens, sees nearly the same: adjusting alone hardly goes
    from one to the other.
    """
    views = np.flatnonzero(beliefs.focal_sds > 0)
    for _ in range(SWEEPS):
        before = adjusted
        for view in views:
            yield
            tried = [adjusted]
            for factor in OTHER_FOCALS:
                rig = Rigid(*(array.copy() for array in adjusted.rig))
                rig.log_focals[view] += np.log(factor)
                rig.translations[view, 2] *= factor
                points = adjusted.points
                near = adjust_rig(
                    rig,
                    points,
                    seen,
                    beliefs,
                    iterations=SWEEP_ITERATIONS,
                    lenses=False,
                    least_noise=least_noise,
                )
                tried.append(near)
            adjusted = _ordered(tried, seen, beliefs)[0]
        if _same(adjusted.rig, before.rig):
            break
    return adjusted


def _nearer(
    rig: Rigid, points: Float64, seen: Seen, beliefs: Beliefs, least_noise: float
) -> Adjusted:
    """Adjust a start, believing less and less noise: what is far off pulls it in at first."""
    adjusted = Adjusted(rig, points, np.full(len(rig.log_focals), least_noise))
    for share in COOLING:
        adjusted = adjust_rig(
            adjusted.rig,
            adjusted.points,
            seen,
            beliefs,
            iterations=MORE_ITERATIONS,
            least_noise=share * least_noise,
        )
    return adjusted


def _finished(adjusted: Adjusted, seen: Seen, beliefs: Beliefs, *, iterations: int) -> Adjusted:
    points = robust_points(adjusted.rig, seen, adjusted.noise)
    return adjust_rig(adjusted.rig, points, seen, beliefs, iterations=iterations)


def _cost(adjusted: Adjusted, seen: Seen, beliefs: Beliefs, noise: Float64) -> float:
    """Minus log posterior under a noise (K,)."""
    distances = distances_of(adjusted.rig, adjusted.points, seen)
    return float(robust_costs(distances, seen.weights, noise).sum()) + prior_cost(
        adjusted.rig, beliefs
    )


def _ordered(rigs: list[Adjusted], seen: Seen, beliefs: Beliefs) -> list[Adjusted]:
    """Sort by cost under one common noise: with each its own, what fits worse could win.

    Points are located anew, since one that an outlier caught says nothing of the cameras.
    """
    common = np.min([rig.noise for rig in rigs], 0)
    located = [
        each._replace(points=robust_points(each.rig, seen, common, start=each.points))
        for each in rigs
    ]
    costs = [_cost(each, seen, beliefs, common) for each in located]
    return [located[place] for place in np.argsort(costs, kind="stable")]


def _distinct(rigs: list[Rigid], most: int) -> list[Rigid]:
    """Return the first rigs of which no two are one."""
    kept: list[Rigid] = []
    for rig in rigs:
        if len(kept) < most and not any(_same(rig, other) for other in kept):
            kept.append(rig)
    return kept


def _same(rig: Rigid, other: Rigid) -> bool:
    turns = [r.rotations @ r.rotations[0].T for r in (rig, other)]
    relative = turns[0] @ turns[1].mT
    cosines = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    angles = np.arccos(cosines.clip(-1, 1))
    return bool(angles.max() < SAME and np.abs(rig.log_focals - other.log_focals).max() < SAME)


def _out_of_line(alone: Float64, sizes: Float64) -> int | None:
    """Return the view that does not rest with the others, if there is one."""
    relative = alone / sizes
    worst = int(relative.argmax())
    common = float(np.sort(alone)[(len(alone) - 1) // 2])
    beyond = len(alone) > 2 and alone[worst] > OUT_OF_LINE * max(common, 1e-3)
    return worst if beyond or relative[worst] > NO_RIG else None


def _result(
    chosen: _Chosen, images: Float64, weights: Float64, beliefs: Beliefs, members: list[int]
) -> RestingRig:
    """Triangulate every frame with both hands, and say what each frame says for which."""
    frames, views, keypoints, _ = images.shape
    resting = np.zeros(views, bool)
    resting[members] = True
    every = Seen(
        images[:, members].transpose(1, 3, 0, 2).reshape(len(members), 2, -1),
        weights[:, members].transpose(1, 0, 2).reshape(len(members), -1),
    )
    known = np.flatnonzero((every.weights > 0).sum(0) >= 2)
    some = Seen(every.images[..., known], every.weights[:, known])
    noise = chosen.adjusted.noise
    explanations, costs, located = [], [], []
    for rig in (chosen.adjusted.rig, chosen.mirror.rig):
        found = robust_points(rig, some, noise)
        points = np.full((frames * keypoints, 3), np.nan)
        points[known] = found.T
        whole = _of_all_views(rig, beliefs, members)
        explanations.append(Explanation(whole, points.reshape(frames, keypoints, 3)))
        located.append(found)
        robust = robust_costs(distances_of(rig, found, some), some.weights, noise)
        costs.append(np.bincount(known // keypoints, robust.sum(0), frames))
    best, mirror = explanations
    odds = np.asarray(costs[1] - costs[0], np.float64)
    deviations = np.full((views, CAMERA), np.inf)
    deviations[members] = chosen.certainty.deviations
    of_frames = known // keypoints
    asked = np.flatnonzero(of_frames % math.ceil(frames / MOST_FRAMES) == 0)
    motion = camera_motion(
        chosen.adjusted.rig,
        located[0][:, asked],
        Seen(some.images[..., asked], some.weights[:, asked]),
        noise,
        of_frames[asked],
    )
    return RestingRig(
        best,
        mirror,
        resting,
        float(np.median(noise)),
        odds,
        chosen.certainty.focals,
        deviations,
        motion,
    )


def _of_all_views(rig: Rigid, beliefs: Beliefs, members: list[int]) -> Rigid:
    """Give the cameras of some views their places among all."""
    views = len(beliefs.focals)
    whole = Rigid(
        np.log(beliefs.focals),
        np.zeros((views, 2)),
        np.zeros((views, 2)),
        np.full((views, 3, 3), np.nan),
        np.full((views, 3), np.nan),
    )
    for array, row in zip(whole, rig, strict=True):
        array[members] = row
    return whole
