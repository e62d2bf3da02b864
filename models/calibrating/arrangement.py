"""Which cameras rest relative to each other, and where.

What a view's keypoints say in frames that nothing was learnt from decides, not the cameras.
"""

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import gather
from models.bundle.problem import Scene, make_rig
from models.bundle.shape_model import align
from models.calibrating.expectation_maximisation import ROUNDS, about_model, learn, regauge
from models.calibrating.keypoint_rig import rig_from_keypoints
from models.calibrating.lens_prior import rig_prior
from models.calibrating.prediction import (
    Split,
    common_noise,
    predicted_distances,
    split_frames,
    surprise,
)
from models.calibrating.problem import (
    REST_SLACK,
    Problem,
    Solution,
    Steps,
    grouped,
    reprojection_distances,
)
from models.numerics.medians import lower_median
from models.numerics.rotations import nearest_rotations
from models.settings.keypoints import MIN_KEYPOINTS

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MEDIAN_ROUNDS = 10  # of reweighting for a median of rotations
LEAST_ANGLE = 1e-4  # radians, below which rotations weigh alike there
SAME_TURN, SAME_LENS = math.radians(2), 0.04  # starts that differ by less lead to one optimum
MORE_ROUNDS = 2  # of learning, for what has been learnt from nearly the same frames
SURE = 3.0  # standard errors by which hidden keypoints must speak against rest
NEGLIGIBLE = 0.05  # nats of a keypoint, of what lens models leave


class RelativePose(NamedTuple):
    """What takes the frame of view j to that of view k: x_k = R x_j + t, robust means."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (3,) units of the structure
    scatter: float  # degrees, of the rotation from frame to frame


RelativePoses = dict[tuple[int, int], RelativePose]  # by views j < k


class Candidate(NamedTuple):
    """Cameras at rest that are tried: a start on all frames."""

    source: str  # in words
    start: Solution
    members: list[int]  # the views that rest


class Judged(NamedTuple):
    """A candidate after learning, and what it predicts of keypoints it was not shown."""

    candidate: Candidate
    learnt: Solution  # of the frames to learn from
    distances: Float64  # (J, K, P) pixels, NaN where not asked


def find_rest(problem: Problem, moving: Solution, *, declared: bool) -> Steps[tuple[Solution, str]]:
    """Say which views rest relative to each other, and put them at rest.

    There are two ways to a rig: the relative rotations of the `moving` solution, and keypoints
    alone. Each rig is learnt from a part of the frames, like the moving cameras. In the other
    frames some keypoints are hidden, and predicted from the rest. Views rest if they are predicted
    no worse for it. Otherwise the view that suffers most moves, and the others are tried again.
    Views that are `declared` to rest are joined in any case. Also returns the reason in words.
    """
    split = split_frames(len(problem.keypoints))
    part, asked = problem.of(split.learning), problem.of(split.judging)
    free = Candidate("moving", moving, [])
    unjoined = yield from _judge(free, part, asked, split, rounds=MORE_ROUNDS)
    views = list(range(len(moving.rig.groups)))
    members, reason = views, "no two views see enough together"
    while len(members) > 1:
        judged = []
        candidates = yield from _candidates(problem, moving, members)
        for candidate in candidates:
            of_candidate = yield from _judge(candidate, part, asked, split)
            judged.append(of_candidate)
        if not judged:
            break
        best = _best(asked, judged)
        against = _against_rest(asked, unjoined, best)
        resting = best.candidate.members
        figures = (
            f"hidden keypoints are predicted to {np.nanmedian(best.distances):.3g} px if views"
            f" {resting} rest ({best.candidate.source}),"
            f" to {np.nanmedian(unjoined.distances):.3g} px if all move"
        )
        worst = max(resting, key=lambda view: against[view])
        if declared or against[worst] <= 0:
            whole = _on_all_frames(best, split)
            found = yield from learn(problem, whole, rounds=MORE_ROUNDS)
            said = "the cameras were declared static; " if declared else ""
            return found, said + figures
        reason = f"{figures}: view {worst} speaks against rest"
        members = [view for view in resting if view != worst]
    return moving, reason


def _candidates(problem: Problem, moving: Solution, members: list[int]) -> Steps[list[Candidate]]:
    """Return the rigs that keypoints alone and the moving solution say, once if they agree."""
    candidates = []
    by_keypoints = yield from rig_from_keypoints(problem, moving, members)
    if by_keypoints is not None:
        candidates.append(Candidate("from keypoints", by_keypoints.start, by_keypoints.members))
    seen = (problem.weights > 0).sum(-1) >= MIN_KEYPOINTS
    relative: RelativePoses = {}
    for j, k in combinations(members, 2):
        pose = _relative_pose(moving.scene, seen, j, k)
        if pose is not None:
            relative[j, k] = pose
    joined = _largest_component(relative, len(moving.rig.groups))
    if len(joined) > 1:
        start = _at_rest(moving, relative, joined, seen)
        if not (candidates and _agree(candidates[0], Candidate("", start, joined))):
            candidates.append(Candidate("from rotations", start, joined))
    return candidates


def _judge(
    candidate: Candidate, part: Problem, asked: Problem, split: Split, *, rounds: int = ROUNDS
) -> Steps[Judged]:
    """Learn from one part of the frames and predict hidden keypoints of the other."""
    learnt = yield from learn(part, candidate.start.of(split.learning), rounds=rounds)
    yield
    others = candidate.start.scene.of(split.judging)
    return Judged(candidate, learnt, predicted_distances(asked, learnt, others))


def _best(asked: Problem, judged: list[Judged]) -> Judged:
    """Return what predicts best, with the lenses' prior where predictions do not tell."""
    noise = common_noise([each.distances for each in judged], asked.side)

    def cost(each: Judged) -> float:
        surprises = surprise(each.distances, asked.weights, noise)
        prior = rig_prior(asked, each.learnt.rig, given_poses=None)
        return float(np.nansum(surprises)) + prior.cost(each.learnt.rig) / 2

    most = max(len(each.candidate.members) for each in judged)
    return min((e for e in judged if len(e.candidate.members) == most), key=cost)


def _against_rest(asked: Problem, moving: Judged, resting: Judged) -> Float64:
    """By how much (K,) hidden keypoints speak against rest, beyond what chance explains; nats."""
    both = (moving.distances, resting.distances)
    noise = common_noise(list(both), asked.side)
    free, joined = (surprise(distances, asked.weights, noise) for distances in both)
    worse = joined - free  # (J, K)
    against = np.full(worse.shape[1], -np.inf)
    for k, column in enumerate(worse.T):
        known = column[np.isfinite(column)]
        if len(known) > 1:
            error = float(known.std(ddof=1)) / math.sqrt(len(known))
            against[k] = known.mean() - SURE * error - NEGLIGIBLE
    return against


def _on_all_frames(judged: Judged, split: Split) -> Solution:
    """Return what was learnt from one part of the frames as a start on all of them."""
    start, learnt = judged.candidate.start, judged.learnt
    points, similarity = align(start.scene.points, learnt.shapes.mean)
    scene = regauge(start.scene, points, similarity, learnt.rig)
    for whole, of_part in zip(scene, learnt.scene, strict=True):
        whole[split.learning] = of_part
    return learnt._replace(scene=scene, prior=about_model(learnt.shapes, len(points)))


def _agree(one: Candidate, other: Candidate) -> bool:
    """Whether two rigs are so near to each other that learning makes them one."""
    if one.members != other.members:
        return False
    members = np.array(one.members)
    first, second = (
        c.start.rig.rotations[members] @ c.start.rig.rotations[members[0]].T for c in (one, other)
    )
    focals = [np.log(c.start.rig.lenses.focals[members]) for c in (one, other)]
    turns = _angles(first @ second.mT)
    return bool(turns.max() < SAME_TURN and np.abs(focals[0] - focals[1]).max() < SAME_LENS)


def worst_view(problem: Problem, moving: Solution, other: Solution, members: list[int]) -> int:
    """Return the member whose median residual grows most from the moving solution to another."""
    seen = problem.weights > 0
    before, after = (
        np.array([lower_median(distances[:, k][seen[:, k]]) for k in members])
        for distances in (
            reprojection_distances(problem, solution.rig, solution.scene)
            for solution in (moving, other)
        )
    )
    return members[int((after / (before + REST_SLACK * problem.side)).argmax())]


def _relative_pose(scene: Scene, seen: Bool, j: int, k: int) -> RelativePose | None:
    """Return the pose of view k relative to view j, each a group; None if it cannot be told."""
    both = seen[:, j] & seen[:, k]
    if both.sum() < 2:
        return None
    relative = scene.rotations[both, k] @ scene.rotations[both, j].mT  # (n, 3, 3)
    weights = np.ones(len(relative))
    for _ in range(MEDIAN_ROUNDS):  # the median of rotations, by reweighting
        mean = nearest_rotations(np.einsum("n,nij->ij", weights, relative))
        angles = _angles(relative @ mean.T)
        weights = 1 / angles.clip(LEAST_ANGLE)
    shifts = scene.translations[both, k] - scene.translations[both, j] @ mean.T
    scatter = math.degrees(float(lower_median(angles)))
    return RelativePose(mean, lower_median(shifts, 0), scatter)


def _angles(rotations: Float64) -> Float64:
    """Angles (n,) in radians of rotations (n, 3, 3)."""
    cosines = (rotations.trace(axis1=-2, axis2=-1) - 1) / 2
    angles: Float64 = np.arccos(cosines.clip(-1, 1))
    return angles


def _largest_component(relative: RelativePoses, views: int) -> list[int]:
    """Return the largest set of views that known relative poses connect."""
    label = list(range(views))
    for j, k in relative:
        old, new = label[k], label[j]
        label = [new if x == old else x for x in label]
    largest = max(set(label), key=label.count)
    return [k for k in range(views) if label[k] == largest]


def _at_rest(moving: Solution, relative: RelativePoses, members: list[int], seen: Bool) -> Solution:
    """Join `members` of the moving solution to one group; the others stay on their own."""
    rig, scene = moving.rig, moving.scene
    rotations, translations = rig.rotations.copy(), rig.translations.copy()
    placed = {members[0]}
    while len(placed) < len(members):  # along the surest relative poses
        options = [pair for pair in relative if (pair[0] in placed) != (pair[1] in placed)]
        j, k = min(options, key=lambda pair: relative[pair].scatter)
        rotation, translation, _ = relative[j, k]
        if j in placed:
            rotations[k] = rotation @ rotations[j]
            translations[k] = rotation @ translations[j] + translation
            placed.add(k)
        else:
            rotations[j] = rotation.T @ rotations[k]
            translations[j] = rotation.T @ (translations[k] - translation)
            placed.add(j)
    groups = grouped(members, len(rig.groups))
    joined = make_rig(rig.lenses, groups, rotations, translations)
    return moving._replace(rig=joined, scene=gather(scene, joined, seen))
