"""Which cameras are static relative to each other, and their poses.

The decision is by the prediction of hidden keypoints in held-out frames.
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
    same_handedness,
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
    CalibrationProblem,
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
MORE_ROUNDS = 2  # of learning, for a solution learnt from nearly the same frames
SURE = 3.0  # standard errors by which static cameras must predict worse to be rejected
MORE_NOISE = 1.4  # times the noise of moving cameras: a static rig may not have more
NEARLY = 3.0  # times the errors of lens models: a rig that predicts so well may not have converged
LAST_ROUNDS = 8  # of learning, before it counts as moving
NEGLIGIBLE = 0.05  # nats of a keypoint, due to errors of lens models


class RelativePose(NamedTuple):
    """The pose of view k relative to view j: x_k = R x_j + t, robust means."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (3,) units of the structure
    scatter: float  # degrees, of the rotation from frame to frame


RelativePoses = dict[tuple[int, int], RelativePose]  # by views j < k


class StaticViews(NamedTuple):
    """The static cameras, and why they are."""

    solution: Solution
    reason: str
    # Log odds (N,) of its handedness against the other, frame by frame, from each evidence.
    evidence: list[Float64]
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
    # Standard deviations (K, VIEW) of cameras that were estimated from the rigid scene rather than
    # with shapes; infinite for the others. None: no camera was.
    kept: Float64 | None = None


class RigCandidate(NamedTuple):
    """A static rig to try: a start on all frames."""

    source: str  # in words
    start: Solution
    members: list[int]  # the static views
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
    kept: Float64 | None = None  # as in `StaticViews`


class JudgedRig(NamedTuple):
    """A candidate after learning, and its prediction of hidden keypoints."""

    candidate: RigCandidate
    learnt: Solution  # of the frames to learn from
    distances: Float64  # (J, K, P) pixels, NaN where not predicted
    against: Float64  # (K,) nats by which static cameras predict worse, beyond chance

    @property
    def merits(self) -> tuple[bool, int]:
        """Whether the keypoints agree with it, and its number of static views."""
        members = self.candidate.members
        return bool((self.against[members] <= 0).all()), len(members)


def find_static(
    problem: CalibrationProblem,
    handed: Handed,
    moving: Solution,
    *,
    declared: bool,
    hint: Corners | None,
) -> Steps[StaticViews]:
    """Find which views are static relative to each other, and estimate their poses.

    There are two ways to a rig: keypoints alone, and the relative rotations of the `moving`
    solution. Each rig is learnt from a part of the frames, like the moving cameras. In the other
    frames some keypoints are hidden, and predicted from all others. Views are static if the
    prediction is no worse than with moving cameras. Otherwise the worst view becomes moving, and
    the others are tried again. Views that are `declared` static are joined in any case. The `hint`
    are four keypoints that determine the handedness (see `choose_handedness`); `handed` is the
    solution from which the moving one was learnt.
    """
    split = split_frames(len(problem.keypoints))
    alone = RigCandidate("", moving, [], problem.lens_groups)
    unjoined = yield from _judge(alone, problem, split, rounds=MORE_ROUNDS)
    members, reason = list(range(len(moving.rig.groups))), "no two views share enough keypoints"
    while len(members) > 1:
        found = yield from rig_from_keypoints(problem, moving, members)
        candidates = [] if found is None else _by_keypoints(problem, moving, found, hint)
        groups = problem.lens_groups if found is None else found.lens_groups
        if len(members) == 2:
            # Two views need shapes to determine their lenses, which moving cameras have learnt.
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
        static = best.candidate.members
        figures = (
            f"hidden keypoints are predicted to {typical_distance(best.distances):.3g} px if views"
            f" {static} are static ({best.candidate.source}),"
            f" to {typical_distance(unjoined.distances):.3g} px if all move"
        )
        if best.merits[0]:
            whole = _on_all_frames(best, split)
            kept = _believing(problem, best.candidate)
            solution = yield from learn(kept, whole, rounds=MORE_ROUNDS)
            prefix = "the cameras were declared static; " if declared else ""
            evidence = _evidence(solution, handed, found)
            return StaticViews(
                solution,
                prefix + figures,
                evidence,
                best.candidate.lens_groups,
                best.candidate.kept,
            )
        worst = max(static, key=list(best.against).__getitem__)
        reason = f"{figures}: view {worst} is not static"
        members = [view for view in static if view != worst]
    return StaticViews(moving, reason, _evidence(moving, handed, None), problem.lens_groups)


def _by_keypoints(
    problem: CalibrationProblem, moving: Solution, found: KeypointRig, hint: Corners | None
) -> list[RigCandidate]:
    """Return the rig from keypoints alone, and its mirror image if they hardly distinguish both."""
    noise = max(found.noise, moving.measured_noise)
    kept = found.deviations if len(found.members) > 2 and noise > CLEAR * problem.size else None
    members, groups = found.members, found.lens_groups
    ours = RigCandidate("from keypoints", found.start, members, groups, kept)
    theirs = RigCandidate("from keypoints, mirrored", found.mirror, members, groups, kept)
    if hint is not None:
        return [ours if volume(found.start.scene.points, hint) > 0 else theirs]
    return [ours] if certainty([found.log_odds]) > DECIDED else [ours, theirs]


def _by_rotations(
    problem: CalibrationProblem, moving: Solution, members: list[int], groups: NDArray[np.int64]
) -> RigCandidate | None:
    """Return the rig from the relative rotations of the moving solution."""
    seen = (problem.weights > 0).sum(-1) >= MIN_KEYPOINTS
    relative: RelativePoses = {}
    for j, k in combinations(members, 2):
        pose = _relative_pose(moving.scene, seen, j, k)
        if pose is not None:
            relative[j, k] = pose
    joined = _largest_component(relative, len(moving.rig.groups))
    if len(joined) < 2:
        return None
    return RigCandidate("from rotations", _joined(moving, relative, joined, seen), joined, groups)


def _believing(problem: CalibrationProblem, candidate: RigCandidate) -> CalibrationProblem:
    """Return the problem with the candidate's lens groups, or with cameras that are held.

    Noisy structures are adjusted towards the shape model, and focal lengths follow: they come out 5
    to 20 % short. Points of a rigid scene that three views see have no such prior.
    """
    problem = problem._replace(lens_groups=candidate.lens_groups)
    if candidate.kept is None:
        return problem
    return problem._replace(kept=np.all(np.isfinite(candidate.kept), 1))


def _judge(
    candidate: RigCandidate,
    problem: CalibrationProblem,
    split: Split,
    *,
    rounds: int = ROUNDS,
    learnt: Solution | None = None,
) -> Steps[JudgedRig]:
    """Learn, or learn on, from one part of the frames; predict hidden keypoints of the other."""
    part = _believing(problem, candidate).of(split.learning)
    start = candidate.start.of(split.learning) if learnt is None else learnt
    learnt = yield from learn(part, start, rounds=rounds)
    yield
    others = candidate.start.scene.of(split.judging)
    distances = predicted_distances(problem.of(split.judging), learnt, others)
    return JudgedRig(candidate, learnt, distances, np.zeros(distances.shape[1]))


def _best(
    candidates: list[RigCandidate],
    problem: CalibrationProblem,
    split: Split,
    moving: JudgedRig | None,
    best: JudgedRig | None = None,
) -> Steps[JudgedRig | None]:
    """Compare candidates with the best so far, and with `moving` unless declared static.

    A candidate that the keypoints do not determine is dropped.
    """
    for candidate in candidates:
        try:
            judged = yield from _judge(candidate, problem, split)
        except np.linalg.LinAlgError:
            continue
        asked = problem.of(split.judging)
        if moving is not None:
            judged = judged._replace(against=_against_static(asked, moving, judged))
            # With noise, more rounds only pull cameras further towards the shape model.
            clear = moving.learnt.measured_noise < CLEAR * problem.size
            near = typical_distance(judged.distances) < NEARLY * LENS_ERRORS * asked.side
            if clear and near and not judged.merits[0]:
                judged = yield from _judge(
                    candidate, problem, split, rounds=LAST_ROUNDS, learnt=judged.learnt
                )
                judged = judged._replace(against=_against_static(asked, moving, judged))
        best = _better(asked, best, judged)
    return best


def _better(asked: CalibrationProblem, first: JudgedRig | None, other: JudgedRig) -> JudgedRig:
    """Return the other if it ranks higher, or predicts better beyond chance."""
    if first is None or other.merits != first.merits:
        return other if first is None or other.merits > first.merits else first
    return other if predicts_better(asked, first.distances, other.distances) else first


def _evidence(solution: Solution, handed: Handed, found: KeypointRig | None) -> list[Float64]:
    """Return the log odds of a solution's handedness from moving cameras and the rig."""
    evidence = [(handed.solution.scene.points, handed.log_odds)]
    if found is not None:
        evidence.append((found.start.scene.points, found.log_odds))
    return [
        odds if same_handedness(solution.scene.points, points) else -odds
        for points, odds in evidence
    ]


def _against_static(asked: CalibrationProblem, moving: JudgedRig, static: JudgedRig) -> Float64:
    """Return by how many nats (K,) static cameras predict hidden keypoints worse, beyond chance."""
    both = (moving.distances, static.distances)
    noise = common_noise(list(both), asked.side)
    free, joined = (surprise(distances, asked.weights, noise) for distances in both)
    worse = joined - free  # (J, K)
    against = np.full(worse.shape[1], -np.inf)
    for k, column in enumerate(worse.T):
        known = column[np.isfinite(column)]
        if len(known) > 1:
            error = float(known.std(ddof=1)) / math.sqrt(len(known))
            against[k] = known.mean() - SURE * error - NEGLIGIBLE
    # Few hidden keypoints have little information; the noise of those learnt from counts, too.
    bearable = math.hypot(MORE_NOISE * moving.learnt.measured_noise, LENS_ERRORS * asked.side)
    if static.learnt.measured_noise > bearable:
        members = static.candidate.members
        most = float(against[members].max())
        if most == -math.inf:  # no keypoint could be hidden
            against[members] = NEGLIGIBLE
        else:
            against[members] += max(NEGLIGIBLE - most, 0.0)
    return against


def _on_all_frames(judged: JudgedRig, split: Split) -> Solution:
    """Return the solution learnt from one part of the frames as a start on all of them."""
    start, learnt = judged.candidate.start, judged.learnt
    points, similarity = align(start.scene.points, learnt.shapes.mean)
    scene = regauge(start.scene, points, similarity, learnt.rig)
    for whole, of_part in zip(scene, learnt.scene, strict=True):
        whole[split.learning] = of_part
    return learnt._replace(scene=scene, prior=about_model(learnt.shapes, len(points)))


def _relative_pose(scene: Scene, seen: Bool, j: int, k: int) -> RelativePose | None:
    """Return the pose of view k relative to view j, each a group; None if undetermined."""
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
    """Return the angles (n,) in radians of rotations (n, 3, 3)."""
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


def _joined(moving: Solution, relative: RelativePoses, members: list[int], seen: Bool) -> Solution:
    """Join `members` of the moving solution to one group; the others stay separate."""
    rig, scene = moving.rig, moving.scene
    rotations, translations = rig.rotations.copy(), rig.translations.copy()
    placed = {members[0]}
    while len(placed) < len(members):  # along the most certain relative poses
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
