"""One frame's normal equations, compiled: linearised, then reduced by eliminating the points.

The unknowns besides the points are in this order: for each group g its pose (7 columns from 7 g),
then the components of the shape prior (Q columns from 7 G); if the equations are those of the rig,
too, eleven columns for each view, from 7 G + Q + 11 k.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import LENS, POSE, SIMILARITY, VIEW, Rig, Scene, ShapePrior, Views
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky_solve, copy, fill, inverse
from models.numerics.tiny import TINY
from models.optics.lenses.projection import differentiate_into

Float64 = NDArray[np.float64]

OUTLIER = 3.0  # noise standard deviations from which a keypoint's gradient is constant (Huber)
SIZE = 6  # place of the log size or stretch in a pose


class NormalEquations(NamedTuple):
    """Normal equations of a frame, or with a leading N of N; C = R + T columns besides the points.

    R = 7 G + Q are the frame's own; T = 11 K are shared by all frames, or T = 0.
    """

    points: Float64  # (P, 3, 3) blocks on the diagonal
    coupling: Float64  # (P, 3, C) of the points and the other unknowns
    others: Float64  # (C, C)
    points_right: Float64  # (P, 3) right-hand side: minus half of the gradient
    others_right: Float64  # (C,)


@inner
def make_equations(count: int, columns: int) -> NormalEquations:
    """Return buffers for the equations of a frame."""
    return NormalEquations(
        np.empty((count, 3, 3)),
        np.empty((count, 3, columns)),
        np.empty((columns, columns)),
        np.empty((count, 3)),
        np.empty(columns),
    )


@inner
def equations_of_frame(equations: NormalEquations, n: int) -> NormalEquations:
    """Return the equations of frame n."""
    return NormalEquations(
        equations.points[n],
        equations.coupling[n],
        equations.others[n],
        equations.points_right[n],
        equations.others_right[n],
    )


@inner
def whiten(points: Float64, prior: ShapePrior, out: Float64) -> tuple[float, float]:
    """Write the prior's precision times (points - mean), (P, 3).

    Returns minus twice the log density, and the inverse variance of the isotropic part.
    """
    size, mean, basis = prior.basis.shape[1], prior.means, prior.basis
    z = np.zeros(size)
    for p in range(len(points)):
        for i in range(3):
            offset = points[p, i] - mean[p, i]
            for q in range(size):
                z[q] += basis[3 * p + i, q] * offset
    cholesky_solve(prior.factor, z)
    weight = 1.0 / (prior.scale * prior.spread) ** 2
    squared = 0.0
    for p in range(len(points)):
        for i in range(3):
            offset = points[p, i] - mean[p, i]
            left = offset
            for q in range(size):
                left -= basis[3 * p + i, q] * z[q]
            out[p, i] = left * weight
            squared += out[p, i] * offset
    if not prior.heavy:
        return squared, weight
    freedom = 3 * len(points) - SIMILARITY
    share = min(freedom / max(squared, TINY), 1.0)  # s^2 over the square of the best scale
    for p in range(len(points)):
        for i in range(3):
            out[p, i] *= share
    return freedom * math.log(1.0 / share) + squared * share, weight * share


@inner
def point_in_group_into(
    rig: Rig, scene: Scene, view: int, growth: float, p: int, turned: Float64, held: Float64
) -> None:
    """Write e^a R X and v = e^a R X + t of one point in the frame of a view's group.

    `growth` is e^a; of a stretched view write R X and diag(e^a, 1, 1) (R X + t).
    """
    group, stretched = rig.groups[view], rig.stretched[view]
    rotation, point = scene.rotations[group], scene.points[p]
    scale = 1.0 if stretched else growth
    for i in range(3):
        turned[i] = scale * (
            rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2]
        )
        held[i] = turned[i] + scene.translations[group, i]
    if stretched:
        held[0] *= growth


@inner
def point_in_camera_into(rig: Rig, view: int, held: Float64, camera: Float64) -> None:
    """Write C v + d."""
    rotation = rig.rotations[view]
    for i in range(3):
        camera[i] = (
            rotation[i, 0] * held[0]
            + rotation[i, 1] * held[1]
            + rotation[i, 2] * held[2]
            + rig.translations[view, i]
        )


@inner
def linearise(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, out: NormalEquations
) -> None:
    """Write the normal equations; if `out` has columns for them, also those of the rig."""
    own = POSE * len(scene.sizes) + prior.basis.shape[1]  # columns of the frame alone
    shared = len(out.others_right) > own
    columns = POSE + (VIEW if shared else 0)  # that one keypoint depends on
    block, right = np.empty((columns, columns)), np.empty(columns)
    _linearise_priors(rig, prior, scene, out)
    for k in range(len(views.keypoints)):
        pose_at = POSE * rig.groups[k]  # where the columns of the pose and of the view begin
        view_at = own + VIEW * k
        fill(block, 0)
        fill(right, 0)
        _linearise_view(views, rig, scene, k, pose_at, view_at, block, right, out)
        for a in range(columns):
            row = pose_at + a if a < POSE else view_at + a - POSE
            out.others_right[row] += right[a]
            for b in range(columns):
                column = pose_at + b if b < POSE else view_at + b - POSE
                out.others[row, column] += block[a, b]


@inner
def _linearise_priors(rig: Rig, prior: ShapePrior, scene: Scene, out: NormalEquations) -> None:
    """Write the equations of the shape prior and of the sizes alone."""
    fill(out.points, 0)
    fill(out.coupling, 0)
    fill(out.others, 0)
    fill(out.others_right, 0)
    components, components_at = prior.basis.shape[1], POSE * len(scene.sizes)
    _, weight = whiten(scene.points, prior, out.points_right)
    for p in range(len(scene.points)):
        for i in range(3):
            out.points_right[p, i] = -out.points_right[p, i]
            out.points[p, i, i] = weight
            for q in range(components):
                out.coupling[p, i, components_at + q] = -weight * prior.basis[3 * p + i, q]
    for q in range(components):
        for r in range(components):
            out.others[components_at + q, components_at + r] = weight * prior.inner[q, r]
    for g in range(len(scene.sizes)):
        at = POSE * g + SIZE
        out.others[at, at] = rig.size_precision[g]
        out.others_right[at] = -rig.size_precision[g] * scene.sizes[g]


@inner
def _linearise_view(
    views: Views,
    rig: Rig,
    scene: Scene,
    view: int,
    pose_at: int,
    view_at: int,
    block: Float64,
    right: Float64,
    out: NormalEquations,
) -> None:
    """Add the terms of a view's keypoints: those of points to `out`, of pose and view to `block`.

    Fields of tuples are looked up once for all keypoints, because counting references takes time.
    """
    group = rig.groups[view]
    growth, stretched = math.exp(scene.sizes[group]), rig.stretched[view]
    scale = 1.0 if stretched else growth
    rotation, outward = scene.rotations[group], rig.rotations[view]
    keypoints, weights, lenses = views.keypoints[view], views.weights[view], rig.lenses
    points, coupling, points_right = out.points, out.coupling, out.points_right
    residual, by_point = np.empty(2), np.empty((2, 3))
    by = np.empty((2, len(right)))  # of the two coordinates by the pose and, if it may move, view
    turned, held, camera, pixel = np.empty(3), np.empty(3), np.empty(3), np.empty(2)
    by_camera, by_held, by_lens = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, LENS))
    for p in range(len(weights)):
        if not weights[p] > 0:
            continue
        point_in_group_into(rig, scene, view, growth, p, turned, held)
        point_in_camera_into(rig, view, held, camera)
        differentiate_into(camera, lenses, view, pixel, by_camera, by_lens)
        squared = 0.0
        for a in range(2):
            residual[a] = keypoints[p, a] - pixel[a]
            squared += weights[p] * residual[a] ** 2
        weight = weights[p] * min(1.0, OUTLIER / math.sqrt(max(squared, TINY)))
        for a in range(2):
            for i in range(3):
                by_held[a, i] = (
                    by_camera[a, 0] * outward[0, i]
                    + by_camera[a, 1] * outward[1, i]
                    + by_camera[a, 2] * outward[2, i]
                )
            if stretched:
                by[a, SIZE] = by_held[a, 0] * held[0]
                by_held[a, 0] *= growth
            else:
                by[a, SIZE] = (
                    by_held[a, 0] * turned[0]
                    + by_held[a, 1] * turned[1]
                    + by_held[a, 2] * turned[2]
                )
            for i in range(3):
                by_point[a, i] = scale * (
                    by_held[a, 0] * rotation[0, i]
                    + by_held[a, 1] * rotation[1, i]
                    + by_held[a, 2] * rotation[2, i]
                )
            _by_rotation_vector_into(by_held[a], turned, by[a, :3])
            for i in range(3):
                by[a, 3 + i] = by_held[a, i]
        if len(right) > POSE:
            _by_view_into(rig, view, camera, by_camera, by_lens, held, by)
        _add_point(by_point, by, weight, p, pose_at, view_at, points, coupling)
        for i in range(3):
            u, v = weight * by_point[0, i], weight * by_point[1, i]
            points_right[p, i] += u * residual[0] + v * residual[1]
        _add_columns(residual, by, weight, block, right)


@inner
def _by_view_into(
    rig: Rig,
    view: int,
    camera: Float64,
    by_camera: Float64,
    by_lens: Float64,
    arm: Float64,
    by: Float64,
) -> None:
    """Write the derivatives of a pixel by its view's eleven numbers; `arm` (3,) is a buffer."""
    for i in range(3):  # C v
        arm[i] = camera[i] - rig.translations[view, i]
    for a in range(2):
        for i in range(LENS):
            by[a, POSE + i] = by_lens[a, i]
        _by_rotation_vector_into(by_camera[a], arm, by[a, POSE + LENS : POSE + LENS + 3])
        for i in range(3):
            by[a, POSE + LENS + 3 + i] = by_camera[a, i]


@inner
def _by_rotation_vector_into(by: Float64, arm: Float64, out: Float64) -> None:
    """Write the derivative by a small rotation vector of `arm` (3,): by (3,) times -[arm]_x."""
    out[0] = arm[1] * by[2] - arm[2] * by[1]
    out[1] = arm[2] * by[0] - arm[0] * by[2]
    out[2] = arm[0] * by[1] - arm[1] * by[0]


@inner
def _add_point(
    by_point: Float64,
    by: Float64,
    weight: float,
    p: int,
    pose_at: int,
    view_at: int,
    points: Float64,
    coupling: Float64,
) -> None:
    """Add to a point's block and to its coupling with pose and view."""
    for i in range(3):
        u, v = weight * by_point[0, i], weight * by_point[1, i]
        for j in range(3):
            points[p, i, j] += u * by_point[0, j] + v * by_point[1, j]
        for a in range(POSE):
            coupling[p, i, pose_at + a] += u * by[0, a] + v * by[1, a]
        for a in range(POSE, by.shape[1]):
            coupling[p, i, view_at + a - POSE] += u * by[0, a] + v * by[1, a]


@inner
def _add_columns(
    residual: Float64, by: Float64, weight: float, block: Float64, right: Float64
) -> None:
    """Add to the block of pose and view, and to their right-hand side."""
    for a in range(len(right)):
        u, v = weight * by[0, a], weight * by[1, a]
        right[a] += u * residual[0] + v * residual[1]
        for b in range(len(right)):
            block[a, b] += u * by[0, b] + v * by[1, b]


@compiled
def eliminate(
    equations: NormalEquations,
    damping: float,
    inverses: Float64,
    reduced: Float64,
    right: Float64,
) -> None:
    """Eliminate the points: write their damped inverse blocks (P, 3, 3) and the Schur complement.

    Only the lower half of the complement (C, C) is written, and its right-hand side (C,).
    """
    size = len(right)
    block, carried = np.empty((3, 3)), np.empty((3, size))
    for a in range(size):
        right[a] = equations.others_right[a]
        for b in range(a + 1):
            reduced[a, b] = equations.others[a, b]
        reduced[a, a] += damping * equations.others[a, a] + TINY
    for p in range(len(inverses)):
        copy(equations.points[p], block)
        for i in range(3):
            block[i, i] += damping * equations.points[p, i, i]
        inverse(block, inverses[p])
        coupling = equations.coupling[p]  # (3, C)
        for i in range(3):
            x, y, z = inverses[p, i, 0], inverses[p, i, 1], inverses[p, i, 2]
            for a in range(size):
                carried[i, a] = x * coupling[0, a] + y * coupling[1, a] + z * coupling[2, a]
        x, y, z = equations.points_right[p]
        for a in range(size):
            right[a] -= carried[0, a] * x + carried[1, a] * y + carried[2, a] * z
            u, v, w = coupling[0, a], coupling[1, a], coupling[2, a]
            row = reduced[a]
            for b in range(a + 1):
                row[b] -= u * carried[0, b] + v * carried[1, b] + w * carried[2, b]


@inner
def back_substitute(
    equations: NormalEquations, inverses: Float64, others_step: Float64, points_step: Float64
) -> None:
    """Write the step of the points (P, 3) from that of the other unknowns."""
    left = np.empty(3)
    for p in range(len(points_step)):
        for i in range(3):
            total = equations.points_right[p, i]
            for a in range(len(others_step)):
                total -= equations.coupling[p, i, a] * others_step[a]
            left[i] = total
        for i in range(3):
            points_step[p, i] = (
                inverses[p, i, 0] * left[0]
                + inverses[p, i, 1] * left[1]
                + inverses[p, i, 2] * left[2]
            )
