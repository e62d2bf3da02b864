"""Lifting with perspective: what a fit found out about its cameras, applied to any frames.

Compiled: a frame goes from the network's answer to its refined one without leaving machine code.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from models.bundle.adjustment import Rig, ShapePrior
from models.bundle.frame import (
    Cameras,
    Pose,
    Shapes,
    copy_pose,
    cost_of,
    descend,
    hold,
    make_pose,
    to_camera,
)
from models.bundle.initial_poses import gather_frame, start_view
from models.calibrating.self_calibration import Discovery, size_precision
from models.capture.observations import Observations
from models.network.answers import Answers
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, identity, product, total
from models.numerics.rotations import nearest_rotation_into
from models.optics.lenses import Optics, see

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

ITERATIONS = 12
LOST = 3.0  # noise standard deviations of a frame's mean residual that a rig at rest cannot explain
BETTER = 0.5  # share of its cost that such a frame must do with if its cameras move
WORSE = 1.25  # times the network's reprojection error: no refinement that leads there is kept


class Refiner(NamedTuple):
    """What is known of K views and of the shapes they will see, laid out for `refine_frames`."""

    rig: Cameras
    apart: Cameras  # the same lenses, every view moving on its own
    mean: Float64  # (P, 3) the frame of reference of the shapes
    doubted: bool  # whether shapes are about the network's answers, or about the mean
    shapes: Shapes
    scales: Float64  # (V,) of the doubts with one view, two, ... V or more
    noise: float  # pixels
    unit: float  # the user's, of a unit of the structure


class Attempt(NamedTuple):
    """Room for one way of explaining a frame."""

    points: Float64  # (P, 3)
    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)
    errors: Float64  # (K,)


def make_refiner(found: Discovery, views: Sequence[int] | None, count: int) -> Refiner:
    """Prepare to refine frames of `views` of the fit, or of `count` cameras it does not know."""
    rig = sub_rig(found, views, count)
    apart = rig._replace(
        groups=torch.arange(count),
        rotations=torch.eye(3, dtype=torch.float64).expand_as(rig.rotations),
        translations=torch.zeros_like(rig.translations),
    )
    doubts, shapes = found.doubts, found.shapes
    doubted = len(doubts.scales) > 0
    believed = doubts if doubted else shapes
    prior = ShapePrior(
        shapes.mean, believed.basis, believed.spread, torch.ones(1), heavy=doubted
    ).shapes()
    return Refiner(
        rig.cameras(size_precision(rig)),
        apart.cameras(size_precision(apart)),
        np.ascontiguousarray(shapes.mean.numpy()),
        doubted,
        prior,
        np.ascontiguousarray(doubts.scales.numpy()) if doubted else np.ones(1),
        found.noise,
        found.unit,
    )


def sub_rig(found: Discovery, views: Sequence[int] | None, count: int) -> Rig:
    """Return the rig of some views of a fit, or of `count` cameras that it does not know.

    Of such cameras only the lenses are known, as the mean of the fit's.
    """
    rig, optics = found.rig, found.rig.optics
    if views is None:
        usual = Optics(
            optics.focals.log().mean(0, keepdim=True).exp().expand(count, -1),
            optics.centres.mean(0, keepdim=True).expand(count, -1),
            optics.distortion.mean(0, keepdim=True).expand(count, -1),
            optics.fisheye[:1].expand(count),
        )
        eye = torch.eye(3, dtype=torch.float64).expand(count, -1, -1)
        still = torch.zeros(count, 3, dtype=torch.float64)
        return Rig(usual, torch.arange(count), eye, still)
    index = torch.tensor(list(views), dtype=torch.long)
    _, groups = torch.unique(rig.groups[index], return_inverse=True)
    alone = (torch.bincount(groups)[groups] == 1)[:, None]  # such a view is its own group's frame
    return Rig(
        Optics(*(a[index] for a in optics)),
        groups,
        torch.where(alone[..., None], torch.eye(3, dtype=torch.float64), rig.rotations[index]),
        torch.where(alone, 0.0, rig.translations[index]),
    )


@compiled
def refine_frames(
    refiner: Refiner,
    seen: Observations,
    previous: Answers,
    always: bool,
    begin: int,
    end: int,
    answers: Answers,
) -> None:
    """Refine the network's weak-perspective answers of frames from `begin` to `end`, in place.

    Frames whose keypoints perspective explains worse than the network, or not at all, stay as they
    are; with `always` only the latter. `previous` are answers of the frames before, N or none: a
    frame whose views all have a perspective camera there starts from it if that explains it better,
    and is marked as continued.
    """
    _, views, count, _ = seen.keypoints.shape
    keypoints, weights = np.empty((views, count, 2)), np.empty((views, count))
    best, other = _room(count, views), _room(count, views)
    start, mean = _room(count, views), np.empty((count, 3))
    joined = len(refiner.rig.size_precision) < views
    for n in range(begin, end):
        there = total(seen.usable[n])
        if not there:
            continue
        for k in range(views):
            for p in range(count):
                w = seen.weights[n, k, p]
                weights[k, p] = w / refiner.noise**2
                for i in range(2):
                    keypoints[k, p, i] = (
                        seen.keypoints[n, k, p, i] * seen.sizes[n, k] + seen.centres[n, k, i]
                    )
        before, cost = False, np.inf
        for way in range(4):  # as the network sees it, mirrored, with views apart, both
            _network_start(refiner, answers, n, seen.usable[n], way % 2 == 1, start, mean)
            if way == 0:
                before = len(previous.points3d) > 0 and _continues(previous, n, seen.usable[n])
                if before:
                    _previous_start(refiner, previous, n, mean, other)
            rig = refiner.rig if way < 2 else refiner.apart
            found, after = _attempt(
                refiner,
                rig,
                keypoints,
                weights,
                seen.usable[n],
                mean,
                start,
                other,
                before and way == 0,
                other,
            )
            if way == 0 or found < BETTER * cost:
                best, other = other, best
                cost = found
                answers.continued[n] = after
            # Frames that the network sees mirrored show, and cameras that were bumped or moved.
            if way == 0 and (there == 1 or not _is_lost(best, seen.usable[n], refiner.noise)):
                break
            if way == 1 and not joined:
                break
        if not _accept(best, cost, answers.reprojection_errors[n], seen.usable[n], always):
            answers.continued[n] = False
            continue
        _write(refiner, best, n, seen.usable[n], answers)


@inner
def _is_lost(attempt: Attempt, usable: NDArray[np.bool_], noise: float) -> bool:
    error = 0.0
    for k in range(len(usable)):
        if usable[k]:
            error += attempt.errors[k]
    return error > LOST * noise * total(usable)


@inner
def _room(count: int, views: int) -> Attempt:
    return Attempt(
        np.empty((count, 3)), np.empty((views, 3, 3)), np.empty((views, 3)), np.empty(views)
    )


@inner
def _align(points: Float64, mean: Float64, turned: Float64, centre: Float64) -> float:
    """As `models.bundle.shape_model.align`: write Q and the centre, return the scale."""
    count = len(points)
    overlap, middle = np.zeros((3, 3)), np.zeros(3)
    fill(centre, 0)
    for p in range(count):
        for i in range(3):
            centre[i] += points[p, i] / count
            middle[i] += mean[p, i] / count
    squared = 0.0
    for p in range(count):
        for i in range(3):
            offset = points[p, i] - centre[i]
            squared += offset * offset
            for j in range(3):
                overlap[i, j] += offset * (mean[p, j] - middle[j])
    nearest_rotation_into(overlap, turned)
    match = 0.0
    for i in range(3):
        for j in range(3):
            match += turned[i, j] * overlap[i, j]
    return match / max(squared, 1e-12)


@inner
def _network_start(
    refiner: Refiner,
    answers: Answers,
    n: int,
    usable: NDArray[np.bool_],
    mirror: bool,
    start: Attempt,
    mean: Float64,
) -> None:
    """Write perspective poses of every view for the network's answer, and the prior's mean.

    All is brought into the frame of reference of the shapes.
    """
    count = len(refiner.mean)
    turned, centre = np.empty((3, 3)), np.empty(3)
    rotation, shift = np.empty((3, 3)), np.empty(2)
    points = np.empty((count, 3))
    for p in range(count):
        for i in range(3):
            points[p, i] = answers.points3d[n, p, i]
        if mirror:
            points[p, 2] = -points[p, 2]
    scale = _align(points, refiner.mean, turned, centre)
    for p in range(count):
        for i in range(3):
            summed = 0.0
            for j in range(3):
                summed += (points[p, j] - centre[j]) * turned[j, i]
            start.points[p, i] = scale * summed
    copy(start.points if refiner.doubted else refiner.mean, mean)
    own = np.empty((3, 3))
    for k in range(len(usable)):
        if usable[k]:
            for i in range(3):
                for j in range(3):
                    own[i, j] = answers.rotations[n, k, i, j]
                    if mirror and (i == 2) != (j == 2):
                        own[i, j] = -own[i, j]
            size = answers.scales[n, k]
            for i in range(2):
                shift[i] = answers.translations[n, k, i]
                for j in range(3):
                    shift[i] += size * own[i, j] * centre[j]
        else:  # harmless numbers
            identity(own)
            size = 1.0
            fill(shift, 0)
        product(own, turned, rotation)
        start_view(
            refiner.rig, k, rotation, size / scale, shift, start.rotations[k], start.translations[k]
        )


@inner
def _continues(previous: Answers, n: int, usable: NDArray[np.bool_]) -> bool:
    for k in range(len(usable)):
        if usable[k] and previous.camera_models[n, k] <= 0:
            return False
    return math.isfinite(previous.points3d[n, 0, 0])


@inner
def _previous_start(
    refiner: Refiner, previous: Answers, n: int, mean: Float64, start: Attempt
) -> None:
    """Write the answer of the frame before in the frame of reference of `mean` (P, 3)."""
    count, unit = len(mean), refiner.unit
    turned, centre, own = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    points = np.empty((count, 3))
    for p in range(count):
        for i in range(3):
            points[p, i] = previous.points3d[n, p, i] / unit
    scale = _align(points, mean, turned, centre)
    for p in range(count):
        for i in range(3):
            summed = 0.0
            for j in range(3):
                summed += (points[p, j] - centre[j]) * turned[j, i]
            start.points[p, i] = scale * summed
    for k in range(len(start.translations)):
        if previous.camera_models[n, k] <= 0:
            identity(own)
        else:
            for i in range(3):
                for j in range(3):
                    own[i, j] = previous.rotations[n, k, i, j]
        product(own, turned, start.rotations[k])
        for i in range(3):
            shift = previous.translations[n, k, i] / unit
            if previous.camera_models[n, k] <= 0:
                shift = 1.0 if i == 2 else 0.0
            for j in range(3):
                shift += own[i, j] * centre[j]
            start.translations[k, i] = scale * shift


@inner
def _attempt(
    refiner: Refiner,
    rig: Cameras,
    keypoints: Float64,
    weights: Float64,
    usable: NDArray[np.bool_],
    mean: Float64,
    start: Attempt,
    second: Attempt,
    two: bool,
    out: Attempt,
) -> tuple[float, bool]:
    """Refine from `start` or, if there are `two` and it is the better one, from the `second`.

    Writes points of their size, poses and errors of every view to `out`, which may be `second`;
    returns minus twice the log posterior, and whether it was the second.
    """
    views, groups, count = len(usable), len(rig.size_precision), len(mean)
    scale = refiner.scales[min(int(total(usable)), len(refiner.scales)) - 1]
    pose = make_pose(count, groups)
    _as_groups(rig, usable, start, pose)
    after = False
    if two:
        other = make_pose(count, groups)
        _as_groups(rig, usable, second, other)
        costs = (
            cost_of(keypoints, weights, rig, mean, scale, refiner.shapes, pose),
            cost_of(keypoints, weights, rig, mean, scale, refiner.shapes, other),
        )
        after = costs[1] < costs[0]
        if after:
            copy_pose(other, pose)
    cost = descend(keypoints, weights, rig, mean, scale, refiner.shapes, pose, ITERATIONS)
    turned, held, camera, pixel = np.empty(3), np.empty(3), np.empty(3), np.empty(2)
    size = math.exp(pose.sizes[0])  # views that move on their own have size 1, distance tells
    for p in range(count):
        for i in range(3):
            out.points[p, i] = pose.points[p, i] * size
    for k in range(views):
        g = rig.groups[k]
        product(rig.rotations[k], pose.rotations[g], out.rotations[k])
        to_camera(rig, k, pose.translations[g], out.translations[k])
        for i in range(3):
            out.translations[k, i] *= size / math.exp(pose.sizes[g])
        summed, observed = 0.0, 0
        for p in range(count):
            if weights[k, p] > 0:
                hold(pose, g, p, turned, held)
                to_camera(rig, k, held, camera)
                see(camera, rig.lenses, k, pixel)
                summed += math.sqrt(
                    (pixel[0] - keypoints[k, p, 0]) ** 2 + (pixel[1] - keypoints[k, p, 1]) ** 2
                )
                observed += 1
        out.errors[k] = summed / max(observed, 1)
    return cost, after


@inner
def _as_groups(rig: Cameras, usable: NDArray[np.bool_], start: Attempt, pose: Pose) -> None:
    """Write the poses of the rig's groups for those of every view."""
    copy(start.points, pose.points)
    if len(pose.sizes) < len(usable):
        gather_frame(
            rig,
            start.rotations,
            start.translations,
            usable,
            pose.rotations,
            pose.translations,
            pose.sizes,
        )
    else:
        for k in range(len(usable)):
            g = rig.groups[k]
            copy(start.rotations[k], pose.rotations[g])
            copy(start.translations[k], pose.translations[g])
            pose.sizes[g] = 0.0


@inner
def _accept(
    attempt: Attempt, cost: float, errors: Float32, usable: NDArray[np.bool_], always: bool
) -> bool:
    """Whether there is an answer, and it explains the keypoints no worse than the network's."""
    if not math.isfinite(cost):
        return False
    ours, theirs = 0.0, 0.0
    for k in range(len(usable)):
        if not math.isfinite(attempt.errors[k]):
            return False
        if usable[k]:
            ours += attempt.errors[k]
            theirs += errors[k]
    return always or ours <= WORSE * theirs


@inner
def _write(
    refiner: Refiner, attempt: Attempt, n: int, usable: NDArray[np.bool_], answers: Answers
) -> None:
    """Write a frame's answer in the user's unit, the structure centred."""
    count, centre = len(attempt.points), np.zeros(3)
    for p in range(count):
        for i in range(3):
            centre[i] += attempt.points[p, i] / count
    for p in range(count):
        for i in range(3):
            answers.points3d[n, p, i] = refiner.unit * (attempt.points[p, i] - centre[i])
    lens = refiner.rig.lenses
    for k in range(len(usable)):
        if not usable[k]:
            continue
        for i in range(3):
            shift = attempt.translations[k, i]
            for j in range(3):
                answers.rotations[n, k, i, j] = attempt.rotations[k, i, j]
                shift += attempt.rotations[k, i, j] * centre[j]
            answers.translations[n, k, i] = refiner.unit * shift
        focal = 0.5 * (lens.focals[k, 0] + lens.focals[k, 1])
        answers.scales[n, k] = focal / answers.translations[n, k, 2]
        for i in range(2):
            answers.focals[n, k, i] = lens.focals[k, i]
            answers.principal_points[n, k, i] = lens.centres[k, i]
        for i in range(8):
            answers.distortions[n, k, i] = lens.distortion[k, i]
        answers.camera_models[n, k] = 2 if lens.fisheye[k] else 1
        answers.reprojection_errors[n, k] = attempt.errors[k]
