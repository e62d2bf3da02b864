"""Which cameras rest relative to each other, and where."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.initial_poses import gather
from models.bundle.problem import Scene, make_rig
from models.calibrating.expectation_maximisation import learn
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

LIKELY_REST = 12.0  # degrees, median scatter of a relative rotation beyond which cameras move
REST_NOISE = 1.4  # times the noise of the moving model: more, and the cameras do not rest
MEDIAN_ROUNDS = 10  # of reweighting for a median of rotations
LEAST_ANGLE = 1e-4  # radians, below which rotations weigh alike there


class RelativePose(NamedTuple):
    """What takes the frame of view j to that of view k: x_k = R x_j + t, robust means."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (3,) units of the structure
    scatter: float  # degrees, of the rotation from frame to frame


RelativePoses = dict[tuple[int, int], RelativePose]  # by views j < k


def find_rest(problem: Problem, moving: Solution, *, declared: bool) -> Steps[tuple[Solution, str]]:
    """Join views that rest relative to each other, as far as the keypoints bear it.

    Views that are `declared` to rest are joined in any case. Also returns the reason in words.
    """
    views = len(moving.rig.groups)
    seen = (problem.weights > 0).sum(-1) >= MIN_KEYPOINTS
    relative: RelativePoses = {}
    for j in range(views):
        for k in range(j + 1, views):
            pose = _relative_pose(moving.scene, seen, j, k)
            if pose is not None and (declared or pose.scatter < LIKELY_REST):
                relative[j, k] = pose
    members = _largest_component(relative, views)
    bound = max(REST_NOISE * moving.noise, moving.noise + REST_SLACK * problem.side)
    reason = f"no two views turn together within {LIKELY_REST:g} degrees"
    while len(members) > 1:
        resting = yield from learn(problem, _at_rest(moving, relative, members, seen))
        figures = (
            f"noise {resting.measured_noise:.3g} px if views {members} rest,"
            f" {moving.measured_noise:.3g} px if all move"
        )
        if declared:
            return resting, f"the cameras were declared static; {figures}"
        if resting.noise <= bound:
            scatter = max(p.scatter for pair, p in relative.items() if set(pair) <= set(members))
            return (
                resting,
                f"{figures}; relative rotations scatter by {scatter:.2g} degrees at most",
            )
        reason = f"{figures}: too much for cameras at rest"
        worst = worst_view(problem, moving, resting, members)
        relative = {pair: pose for pair, pose in relative.items() if worst not in pair}
        members = _largest_component(relative, views)
    return moving, reason


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
