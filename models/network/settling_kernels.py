"""Compiled settling of a frame, for lifts and fits; `settling` explains it."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, inverse_symmetric, total
from models.numerics.normalisation import normalise_into
from models.optics.weak_perspective import (
    CameraSolution,
    new_camera,
    project_into,
    solve_camera_into,
)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

STIFFNESS = 0.05  # pull to the network's structure, where one view seen head-on pulls with about 1
DECISIVE = 0.8  # a frame leaves the handedness of the fit if its error falls below this share


class Buffers(NamedTuple):
    """Buffers that settling overwrites for every frame of K views and P keypoints."""

    camera: CameraSolution
    axes: Float64  # (K, 2, 3) scale times the first two rows of a view's rotation
    target: Float64  # (K, P, 2) keypoints with the foreshortening taken out
    projected: Float64  # (K, P, 2) by weak perspective
    slopes: Float64  # (K, P, 2) by which projections move per unit of foreshortening
    other: Float64  # (P, 3) the structure if its handedness is the other one


@compiled
def new_buffers(views: int, keypoints: int) -> Buffers:
    """Return unfilled buffers for `settle_frame`."""
    return Buffers(
        new_camera(),
        np.empty((views, 2, 3)),
        np.empty((views, keypoints, 2)),
        np.empty((views, keypoints, 2)),
        np.empty((views, keypoints, 2)),
        np.empty((keypoints, 3)),
    )


@compiled
def settle_frames(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    rounds: int,
) -> None:
    """Settle structures (N, P, 3) and guesses (N, K, 3, 3) in place; see `settling.settle`."""
    buffers = new_buffers(*weights.shape[1:])
    for n in range(len(points)):
        settle_frame(
            points[n], keypoints[n], weights[n], guesses[n], foreshortening, rounds, buffers
        )


@compiled
def alternate_frames(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortenings: Float64,
    rounds: int,
) -> None:
    """Move structures (N, P, 3) in place, each by a foreshortening of its own (N,)."""
    buffers = new_buffers(*weights.shape[1:])
    for n in range(len(points)):
        _alternate(
            points[n], keypoints[n], weights[n], guesses[n], foreshortenings[n], rounds, buffers
        )


@compiled
def project_frames(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    rounds: int,
    rotations: Float64,
    projected: Float64,
    slopes: Float64,
) -> None:
    """Compute the results of `settling.first_order_cameras`."""
    camera = new_camera()
    target = np.empty(keypoints.shape[2:])  # (P, 2)
    for n in range(len(points)):
        for k in range(weights.shape[1]):
            whole = total(weights[n, k])
            if whole <= 0:
                copy(guesses[n, k], rotations[n, k])
                fill(projected[n, k], 0)
                fill(slopes[n, k], 0)
                continue
            copy(keypoints[n, k], target)
            for _ in range(rounds):
                scale = solve_camera_into(
                    points[n], target, weights[n, k], whole, guesses[n, k], camera
                ).scale
                _first_order_into(
                    points[n], weights[n, k], whole, camera, scale, projected[n, k], slopes[n, k]
                )
                _straighten_into(keypoints[n, k], slopes[n, k], foreshortening, target)
            copy(camera.rotation, rotations[n, k])


@inner
def settle_frame(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    rounds: int,
    buffers: Buffers,
) -> None:
    """Settle the structure (P, 3) of one frame and its guesses (K, 3, 3) in place.

    `keypoints` (K, P, 2) and `weights` (K, P) are normalised.
    """
    views = 0
    for k in range(len(weights)):
        views += total(weights[k]) > 0
    mirrored = foreshortening < 0
    copy(points, buffers.other)
    error = _alternate(points, keypoints, weights, guesses, foreshortening, rounds, buffers)
    if views > 1:
        other = buffers.other
        error_of_other = _alternate(
            other, keypoints, weights, guesses, -foreshortening, rounds, buffers
        )
        if error_of_other < DECISIVE * error:
            copy(other, points)
            mirrored = not mirrored
    if mirrored:
        mirror_frame(points, guesses)
    normalise_into(points, points)


@inner
def mirror_frame(points: Float64, guesses: Float64) -> None:
    """Turn a structure (P, 3) into its mirror image, and the guesses (K, 3, 3) to see it alike.

    With D = diag(1, 1, -1), the rotation D R D sees D X where R sees X: (D R D)(D X) = D R X has
    the same x and y.
    """
    for p in range(len(points)):
        points[p, 2] = -points[p, 2]
    for k in range(len(guesses)):
        for i in range(2):
            guesses[k, i, 2] = -guesses[k, i, 2]
            guesses[k, 2, i] = -guesses[k, 2, i]


@inner
def _alternate(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    rounds: int,
    buffers: Buffers,
) -> float:
    """Solve for cameras and structure in turn; return the root of the sum of squared errors."""
    copy(keypoints, buffers.target)
    for _ in range(rounds):
        _solve_views(points, keypoints, weights, guesses, foreshortening, buffers)
        _move_points(points, weights, buffers)
    return math.sqrt(_solve_views(points, keypoints, weights, guesses, foreshortening, buffers))


@inner
def _solve_views(
    points: Float64,
    keypoints: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    buffers: Buffers,
) -> float:
    """Compute axes, projections, slopes and targets; return the sum of squared errors."""
    camera, squared = buffers.camera, 0.0
    for k in range(len(weights)):
        whole = total(weights[k])
        if whole <= 0:
            continue
        target, projected, slopes = buffers.target[k], buffers.projected[k], buffers.slopes[k]
        scale = solve_camera_into(points, target, weights[k], whole, guesses[k], camera).scale
        for i in range(2):
            for j in range(3):
                buffers.axes[k, i, j] = scale * camera.rotation[i, j]
        _first_order_into(points, weights[k], whole, camera, scale, projected, slopes)
        _straighten_into(keypoints[k], slopes, foreshortening, target)
        for p in range(len(points)):
            for i in range(2):
                squared += weights[k, p] * (target[p, i] - projected[p, i]) ** 2
    return squared


@inner
def _straighten_into(
    keypoints: Float32, slopes: Float64, foreshortening: float, target: Float64
) -> None:
    """Compute the targets (P, 2): keypoints with the foreshortening taken out."""
    for p in range(len(keypoints)):
        for i in range(2):
            target[p, i] = keypoints[p, i] - foreshortening * slopes[p, i]


@inner
def _first_order_into(
    points: Float64,
    weights: Float32,
    whole: float,
    camera: CameraSolution,
    scale: float,
    projected: Float64,
    slopes: Float64,
) -> None:
    """Compute weak-perspective projections (P, 2), and their slopes by the foreshortening (P, 2).

    With depth z and projection w about their means, the slope is -z w. Its mean is removed, since
    the camera's translation absorbs it. Means are weighted.
    """
    project_into(points, camera, scale, projected)
    axis = camera.rotation[2]
    x, y, z = axis[0], axis[1], axis[2]
    u_mean, v_mean = camera.image_mean[0], camera.image_mean[1]
    z_mean = (
        x * camera.structure_mean[0] + y * camera.structure_mean[1] + z * camera.structure_mean[2]
    )
    u_sum = v_sum = 0.0
    for p in range(len(points)):
        depth = x * points[p, 0] + y * points[p, 1] + z * points[p, 2] - z_mean
        slopes[p, 0] = -depth * (projected[p, 0] - u_mean)
        slopes[p, 1] = -depth * (projected[p, 1] - v_mean)
        u_sum += weights[p] * slopes[p, 0]
        v_sum += weights[p] * slopes[p, 1]
    for p in range(len(points)):
        slopes[p, 0] -= u_sum / whole
        slopes[p, 1] -= v_sum / whole


@inner
def _move_points(points: Float64, weights: Float32, buffers: Buffers) -> None:
    """Move each point (3,) to its least-squares position, held back by the stiffness."""
    normal, solved, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(len(points)):
        fill(normal, 0)
        fill(pull, 0)
        for k in range(len(weights)):
            weight = weights[k, p]
            if weight <= 0:
                continue
            axes = buffers.axes[k]
            u = buffers.target[k, p, 0] - buffers.projected[k, p, 0]
            v = buffers.target[k, p, 1] - buffers.projected[k, p, 1]
            for i in range(3):
                pull[i] += weight * (axes[0, i] * u + axes[1, i] * v)
                for j in range(i, 3):
                    normal[i, j] += weight * (axes[0, i] * axes[0, j] + axes[1, i] * axes[1, j])
        inverse_symmetric(normal, STIFFNESS, solved)
        for i in range(3):
            points[p, i] += solved[i, 0] * pull[0] + solved[i, 1] * pull[1] + solved[i, 2] * pull[2]
