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
from models.calibrating.handedness import (
    DECIDED,
    Corners,
    Handed,
    certainty,
    same_hand,
    volume,
)
from models.calibrating.keypoint_rig import KeypointRig, rig_from_keypoints
from models.calibrating.prediction import (
    LENS_ERRORS,
    Split,
    common_noise,
    predicted_distances,
    predicts_better,
    split_frames,
    surprise,
    typical_distance,
)
from models.calibrating.problem import (
    CLEAR,
    Problem,
    Solution,
    grouped,
)
from models.numerics.medians import lower_median
from models.numerics.rotations import nearest_rotations
from models.numerics.steps import Steps
from models.settings.keypoints import MIN_KEYPOINTS

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

MEDIAN_ROUNDS = 10  # of reweighting for a median of rotations
LEAST_ANGLE = 1e-4  # radians, below which rotations weigh alike there
MORE_ROUNDS = 2  # of learning, for what has been learnt from nearly the same frames
SURE = 3.0  # standard errors by which hidden keypoints must speak against rest
MORE_NOISE = 1.4  # times the noise of moving cameras: no rig at rest has more
NEARLY = 3.0  # times the errors of lens models: what predicts so well may not be learnt to the end
LAST_ROUNDS = 8  # of learning, before it counts as moving
NEGLIGIBLE = 0.05  # nats of a keypoint, of what lens models leave


class RelativePose(NamedTuple):
    """What takes the frame of view j to that of view k: x_k = R x_j + t, robust means."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (3,) units of the structure
    scatter: float  # degrees, of the rotation from frame to frame


RelativePoses = dict[tuple[int, int], RelativePose]  # by views j < k


class Rest(NamedTuple):
    """Which cameras rest."""

    solution: Solution
    reason: str
    # Log odds (N,) of its hand against the other, frame by frame, by each way there is to tell it.
    evidence: list[Float64]
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
    # Standard deviations (K, VIEW) of cameras that are those of the rigid scene, not of the shapes;
    # infinite of those that are not. None: no camera is.
    kept: Float64 | None = None


class Candidate(NamedTuple):
    """Cameras at rest that are tried: a start on all frames."""

    source: str  # in words
    start: Solution
    members: list[int]  # the views that rest
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
    kept: Float64 | None = None  # as in `Rest`


class Judged(NamedTuple):
    """A candidate after learning, and what it predicts of keypoints it was not shown."""

    candidate: Candidate
    learnt: Solution  # of the frames to learn from
    distances: Float64  # (J, K, P) pixels, NaN where not asked
    against: Float64  # (K,) nats by which hidden keypoints speak against rest, beyond chance

    @property
    def merits(self) -> tuple[bool, int]:
        """Whether the keypoints bear it, and how many views rest."""
        members = self.candidate.members
        return bool((self.against[members] <= 0).all()), len(members)


def find_rest(
    problem: Problem, handed: Handed, moving: Solution, *, declared: bool, hint: Corners | None
) -> Steps[Rest]:
    """Say which views rest relative to each other, and put them at rest.

    There are two ways to a rig: keypoints alone, and the relative rotations of the `moving`
    solution. Each rig is learnt from a part of the frames, like the moving cameras. In the other
    frames some keypoints are hidden, and predicted from the rest. Views rest if they are predicted
    no worse for it. Otherwise the view that suffers most moves, and the others are tried again.
    Views that are `declared` to rest are joined in any case. The `hint` are four keypoints that
    tell the hand (see `choose_hand`); `handed` is what the moving solution was learnt from.
    """
    split = split_frames(len(problem.keypoints))
    alone = Candidate("", moving, [], problem.lens_groups)
    unjoined = yield from _judge(alone, problem, split, rounds=MORE_ROUNDS)
    members, reason = list(range(len(moving.rig.groups))), "no two views see enough together"
    while len(members) > 1:
        found = yield from rig_from_keypoints(problem, moving, members)
        candidates = [] if found is None else _by_keypoints(problem, moving, found, hint)
        groups = problem.lens_groups if found is None else found.lens_groups
        if len(members) == 2:
            # Two views say little of their lenses without shapes, which moving cameras have learnt.
            joined = _by_rotations(problem, moving, members, groups)
            candidates = [*([] if joined is None else [joined]), *candidates]
        rival = None if declared else unjoined
        best = yield from _best(candidates, problem, split, rival)
        if len(members) > 2 and (best is None or best.merits != (True, len(members))):
            joined = _by_rotations(problem, moving, members, groups)
            if joined is not None:
                best = yield from _best([joined], problem, split, rival, best)
        if best is None:
            break
        resting = best.candidate.members
        figures = (
            f"hidden keypoints are predicted to {typical_distance(best.distances):.3g} px if views"
            f" {resting} rest ({best.candidate.source}),"
            f" to {typical_distance(unjoined.distances):.3g} px if all move"
        )
        if best.merits[0]:
            whole = _on_all_frames(best, split)
            kept = _believing(problem, best.candidate)
            solution = yield from learn(kept, whole, rounds=MORE_ROUNDS)
            said = "the cameras were declared static; " if declared else ""
            evidence = _evidence(solution, handed, found)
            return Rest(
                solution,
                said + figures,
                evidence,
                best.candidate.lens_groups,
                best.candidate.kept,
            )
        worst = max(resting, key=list(best.against).__getitem__)
        reason = f"{figures}: view {worst} speaks against rest"
        members = [view for view in resting if view != worst]
    return Rest(moving, reason, _evidence(moving, handed, None), problem.lens_groups)


def _by_keypoints(
    problem: Problem, moving: Solution, found: KeypointRig, hint: Corners | None
) -> list[Candidate]:
    """Return the rig that keypoints alone say, and its mirror image if they hardly tell which."""
    noise = max(found.noise, moving.measured_noise)
    kept = found.deviations if len(found.members) > 2 and noise > CLEAR * problem.size else None
    members, groups = found.members, found.lens_groups
    ours = Candidate("from keypoints", found.start, members, groups, kept)
    theirs = Candidate("from keypoints, mirrored", found.mirror, members, groups, kept)
    if hint is not None:
        return [ours if volume(found.start.scene.points, hint) > 0 else theirs]
    return [ours] if certainty([found.log_odds]) > DECIDED else [ours, theirs]


def _by_rotations(
    problem: Problem, moving: Solution, members: list[int], groups: NDArray[np.int64]
) -> Candidate | None:
    """Return the rig that the relative rotations of the moving solution say."""
    seen = (problem.weights > 0).sum(-1) >= MIN_KEYPOINTS
    relative: RelativePoses = {}
    for j, k in combinations(members, 2):
        pose = _relative_pose(moving.scene, seen, j, k)
        if pose is not None:
            relative[j, k] = pose
    joined = _largest_component(relative, len(moving.rig.groups))
    if len(joined) < 2:
        return None
    return Candidate("from rotations", _at_rest(moving, relative, joined, seen), joined, groups)


def _believing(problem: Problem, candidate: Candidate) -> Problem:
    """Return the problem with lenses as alike as the candidate's, or cameras that stay as they are.

    Noisy structures are adjusted towards the shape model, and focal lengths follow them: they
    come out 5 to 20 % short. Points at rest that three views see have no such prior.
    """
    problem = problem._replace(lens_groups=candidate.lens_groups)
    if candidate.kept is None:
        return problem
    return problem._replace(kept=np.all(np.isfinite(candidate.kept), 1))


def _judge(
    candidate: Candidate,
    problem: Problem,
    split: Split,
    *,
    rounds: int = ROUNDS,
    learnt: Solution | None = None,
) -> Steps[Judged]:
    """Learn from one part of the frames, or go on to, and predict hidden keypoints of the other."""
    part = _believing(problem, candidate).of(split.learning)
    start = candidate.start.of(split.learning) if learnt is None else learnt
    learnt = yield from learn(part, start, rounds=rounds)
    yield
    others = candidate.start.scene.of(split.judging)
    distances = predicted_distances(problem.of(split.judging), learnt, others)
    return Judged(candidate, learnt, distances, np.zeros(distances.shape[1]))


def _best(
    candidates: list[Candidate],
    problem: Problem,
    split: Split,
    moving: Judged | None,
    best: Judged | None = None,
) -> Steps[Judged | None]:
    """Judge candidates against the best so far, and against `moving` unless rest is declared.

    What the keypoints do not determine is no rig.
    """
    for candidate in candidates:
        try:
            judged = yield from _judge(candidate, problem, split)
        except np.linalg.LinAlgError:
            continue
        asked = problem.of(split.judging)
        if moving is not None:
            judged = judged._replace(against=_against_rest(asked, moving, judged))
            # With noise, more rounds only pull cameras further towards the shape model.
            clear = moving.learnt.measured_noise < CLEAR * problem.size
            near = typical_distance(judged.distances) < NEARLY * LENS_ERRORS * asked.side
            if clear and near and not judged.merits[0]:
                judged = yield from _judge(
                    candidate, problem, split, rounds=LAST_ROUNDS, learnt=judged.learnt
                )
                judged = judged._replace(against=_against_rest(asked, moving, judged))
        best = _better(asked, best, judged)
    return best


def _better(asked: Problem, first: Judged | None, other: Judged) -> Judged:
    """Return the other if it has greater merits, or predicts better beyond chance."""
    if first is None or other.merits != first.merits:
        return other if first is None or other.merits > first.merits else first
    return other if predicts_better(asked, first.distances, other.distances) else first


def _evidence(solution: Solution, handed: Handed, found: KeypointRig | None) -> list[Float64]:
    """Return what moving cameras and the rig from keypoints say for a solution's hand."""
    evidence = [(handed.solution.scene.points, handed.log_odds)]
    if found is not None:
        evidence.append((found.start.scene.points, found.log_odds))
    return [
        odds if same_hand(solution.scene.points, points) else -odds for points, odds in evidence
    ]


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
    # Few hidden keypoints say little; the noise of all that were learnt from counts, too.
    bearable = math.hypot(MORE_NOISE * moving.learnt.measured_noise, LENS_ERRORS * asked.side)
    if resting.learnt.measured_noise > bearable:
        members = resting.candidate.members
        most = float(against[members].max())
        if most == -math.inf:  # no keypoint could be hidden
            against[members] = NEGLIGIBLE
        else:
            against[members] += max(NEGLIGIBLE - most, 0.0)
    return against


def _on_all_frames(judged: Judged, split: Split) -> Solution:
    """Return what was learnt from one part of the frames as a start on all of them."""
    start, learnt = judged.candidate.start, judged.learnt
    points, similarity = align(start.scene.points, learnt.shapes.mean)
    scene = regauge(start.scene, points, similarity, learnt.rig)
    for whole, of_part in zip(scene, learnt.scene, strict=True):
        whole[split.learning] = of_part
    return learnt._replace(scene=scene, prior=about_model(learnt.shapes, len(points)))


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
