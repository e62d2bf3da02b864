"""One frame's posterior, compiled: its cost, its normal equations, and the way down to its optimum.

`models.bundle.adjustment` says what the unknowns are. Everything is float64 and written into arrays
that the caller gives: P keypoints, K views, G groups, Q components, R = 7 G + Q unknowns beside
points.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, cholesky_solve, copy, fill, inverse, product
from models.numerics.rotations import rotation_from_vector_into
from models.optics.lenses import Lenses, derive, see

Float64 = NDArray[np.float64]

POSE = SIMILARITY = 7  # rotation vector, translation, log size
OPTICS = 4  # log focal length, principal point, first radial coefficient
EXTRINSICS = 6  # rotation vector, translation
VIEW = OPTICS + EXTRINSICS  # what all frames share of a view
OUTLIER = 3.0  # noise standard deviations from which a keypoint pulls with constant force (Huber)
NEAREST = 1e-2  # depth, in units of the structure, behind which no camera sees
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
CONVERGED = 1e-7  # relative decrease of the cost


class Cameras(NamedTuple):
    """A rig of K views in G groups."""

    lenses: Lenses
    groups: NDArray[np.int64]  # (K,)
    rotations: Float64  # (K, 3, 3) group to camera
    translations: Float64  # (K, 3)
    size_precision: Float64  # (G,) inverse variance of the log sizes


class Shapes(NamedTuple):
    """A Gaussian shape prior about means that every frame has of its own."""

    basis: Float64  # (3 P, Q)
    inner: Float64  # (Q, Q) B^T B + spread^2 1
    factor: Float64  # (Q, Q) its Cholesky factor
    spread: float
    heavy: bool


class Pose(NamedTuple):
    """A frame's unknowns."""

    points: Float64  # (P, 3)
    rotations: Float64  # (G, 3, 3)
    translations: Float64  # (G, 3)
    sizes: Float64  # (G,) logarithms


class Equations(NamedTuple):
    """A frame's normal equations; T of the columns beside the points may be shared by all."""

    points: Float64  # (P, 3, 3)
    coupling: Float64  # (P, 3, R + T)
    rest: Float64  # (R + T, R + T)
    pull_points: Float64  # (P, 3) minus the gradient
    pull_rest: Float64  # (R + T,)


@inner
def make_equations(count: int, unknowns: int) -> Equations:
    """Room for the equations of a frame."""
    return Equations(
        np.empty((count, 3, 3)),
        np.empty((count, 3, unknowns)),
        np.empty((unknowns, unknowns)),
        np.empty((count, 3)),
        np.empty(unknowns),
    )


@inner
def make_pose(count: int, groups: int) -> Pose:
    """Room for the unknowns of a frame."""
    return Pose(
        np.empty((count, 3)), np.empty((groups, 3, 3)), np.empty((groups, 3)), np.empty(groups)
    )


@inner
def copy_pose(source: Pose, target: Pose) -> None:
    """Copy the unknowns of a frame."""
    copy(source.points, target.points)
    copy(source.rotations, target.rotations)
    copy(source.translations, target.translations)
    copy(source.sizes, target.sizes)


@inner
def whiten(
    points: Float64, mean: Float64, scale: float, shapes: Shapes, pull: Float64
) -> tuple[float, float]:
    """Write the prior's precision times (points - mean), (P, 3).

    Returns minus twice the log density, and the inverse variance of what is beside the components.
    """
    size = shapes.basis.shape[1]
    z = np.zeros(size)
    for p in range(len(points)):
        for i in range(3):
            offset = points[p, i] - mean[p, i]
            for q in range(size):
                z[q] += shapes.basis[3 * p + i, q] * offset
    cholesky_solve(shapes.factor, z)
    weight = 1.0 / (scale * shapes.spread) ** 2
    squared = 0.0
    for p in range(len(points)):
        for i in range(3):
            offset = points[p, i] - mean[p, i]
            left = offset
            for q in range(size):
                left -= shapes.basis[3 * p + i, q] * z[q]
            pull[p, i] = left * weight
            squared += pull[p, i] * offset
    if not shapes.heavy:
        return squared, weight
    freedom = 3 * len(points) - SIMILARITY
    share = min(freedom / max(squared, 1e-12), 1.0)
    for p in range(len(points)):
        for i in range(3):
            pull[p, i] *= share
    return freedom * math.log(1.0 / share) + squared * share, weight * share


@inner
def hold(pose: Pose, group: int, p: int, turned: Float64, held: Float64) -> None:
    """Write e^a R X and v = e^a R X + t of one point, in the frame of its group."""
    growth = math.exp(pose.sizes[group])
    rotation, point = pose.rotations[group], pose.points[p]
    for i in range(3):
        turned[i] = growth * (
            rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2]
        )
        held[i] = turned[i] + pose.translations[group, i]


@inner
def to_camera(cameras: Cameras, view: int, held: Float64, camera: Float64) -> None:
    """Write C v + d."""
    rotation = cameras.rotations[view]
    for i in range(3):
        camera[i] = (
            rotation[i, 0] * held[0]
            + rotation[i, 1] * held[1]
            + rotation[i, 2] * held[2]
            + cameras.translations[view, i]
        )


@inner
def cost_of(
    keypoints: Float64,
    weights: Float64,
    cameras: Cameras,
    mean: Float64,
    scale: float,
    shapes: Shapes,
    pose: Pose,
) -> float:
    """Minus twice the log posterior, up to a constant; infinite with a point behind a camera."""
    turned, held, camera, pixel = np.empty(3), np.empty(3), np.empty(3), np.empty(2)
    total = 0.0
    for k in range(len(keypoints)):
        for p in range(len(pose.points)):
            w = weights[k, p]
            if w > 0:
                hold(pose, cameras.groups[k], p, turned, held)
                to_camera(cameras, k, held, camera)
                if not camera[2] >= NEAREST:
                    return np.inf
                see(camera, cameras.lenses, k, pixel)
                squared = w * (
                    (pixel[0] - keypoints[k, p, 0]) ** 2 + (pixel[1] - keypoints[k, p, 1]) ** 2
                )
                if squared > OUTLIER**2:
                    squared = 2 * OUTLIER * math.sqrt(squared) - OUTLIER**2
                total += squared
    total += whiten(pose.points, mean, scale, shapes, np.empty((len(pose.points), 3)))[0]
    for g in range(len(pose.sizes)):
        total += cameras.size_precision[g] * pose.sizes[g] ** 2
    return total if math.isfinite(total) else np.inf


@inner
def linearise(
    keypoints: Float64,
    weights: Float64,
    cameras: Cameras,
    mean: Float64,
    scale: float,
    shapes: Shapes,
    pose: Pose,
    out: Equations,
) -> None:
    """Write the normal equations; if there is room, also those of the rig, ten numbers a view."""
    count, groups, components = len(pose.points), len(pose.sizes), shapes.basis.shape[1]
    size = POSE * groups + components
    fill(out.points, 0)
    fill(out.coupling, 0)
    fill(out.rest, 0)
    fill(out.pull_rest, 0)
    # Rows of the two residuals: 7 numbers of the pose, 10 of the view.
    shared = len(out.pull_rest) > size
    own = POSE + (VIEW if shared else 0)
    rows, inner, pull = np.empty((2, own)), np.empty((own, own)), np.empty(own)
    by_point, by_camera, by_held = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    by_optics, residual = np.empty((2, OPTICS)), np.empty(2)
    turned, held, camera, pixel = np.empty(3), np.empty(3), np.empty(3), np.empty(2)

    _, weight = whiten(pose.points, mean, scale, shapes, out.pull_points)
    for p in range(count):
        for i in range(3):
            out.pull_points[p, i] = -out.pull_points[p, i]
            out.points[p, i, i] = weight
            for q in range(components):
                out.coupling[p, i, POSE * groups + q] = -weight * shapes.basis[3 * p + i, q]
    for q in range(components):
        for r in range(components):
            out.rest[POSE * groups + q, POSE * groups + r] = weight * shapes.inner[q, r]
    for g in range(groups):
        at = POSE * g + 6
        out.rest[at, at] = cameras.size_precision[g]
        out.pull_rest[at] = -cameras.size_precision[g] * pose.sizes[g]

    for k in range(len(keypoints)):
        g = cameras.groups[k]
        growth = math.exp(pose.sizes[g])
        outward, rotation = cameras.rotations[k], pose.rotations[g]
        here, there = POSE * g, size + VIEW * k - POSE  # where the columns of pose and view begin
        fill(inner, 0)
        fill(pull, 0)
        for p in range(count):
            if not weights[k, p] > 0:
                continue
            hold(pose, g, p, turned, held)
            to_camera(cameras, k, held, camera)
            derive(camera, cameras.lenses, k, pixel, by_camera, by_optics)
            squared = 0.0
            for a in range(2):
                residual[a] = keypoints[k, p, a] - pixel[a]
                squared += weights[k, p] * residual[a] ** 2
            w = weights[k, p] * min(1.0, OUTLIER / math.sqrt(max(squared, 1e-12)))
            for a in range(2):
                for i in range(3):
                    by_held[a, i] = (
                        by_camera[a, 0] * outward[0, i]
                        + by_camera[a, 1] * outward[1, i]
                        + by_camera[a, 2] * outward[2, i]
                    )
                for i in range(3):
                    by_point[a, i] = growth * (
                        by_held[a, 0] * rotation[0, i]
                        + by_held[a, 1] * rotation[1, i]
                        + by_held[a, 2] * rotation[2, i]
                    )
                _turning(by_held[a], turned, rows[a, :3])
                for i in range(3):
                    rows[a, 3 + i] = by_held[a, i]
                rows[a, 6] = (
                    by_held[a, 0] * turned[0]
                    + by_held[a, 1] * turned[1]
                    + by_held[a, 2] * turned[2]
                )
                if shared:
                    for i in range(OPTICS):
                        rows[a, POSE + i] = by_optics[a, i]
                    for i in range(3):  # C v
                        held[i] = camera[i] - cameras.translations[k, i]
                    _turning(by_camera[a], held, rows[a, POSE + OPTICS : POSE + OPTICS + 3])
                    for i in range(3):
                        rows[a, POSE + OPTICS + 3 + i] = by_camera[a, i]
            for i in range(3):
                u, v = w * by_point[0, i], w * by_point[1, i]
                out.pull_points[p, i] += u * residual[0] + v * residual[1]
                for j in range(3):
                    out.points[p, i, j] += u * by_point[0, j] + v * by_point[1, j]
                for a in range(POSE):
                    out.coupling[p, i, here + a] += u * rows[0, a] + v * rows[1, a]
                for a in range(POSE, own):
                    out.coupling[p, i, there + a] += u * rows[0, a] + v * rows[1, a]
            for a in range(own):
                u, v = w * rows[0, a], w * rows[1, a]
                pull[a] += u * residual[0] + v * residual[1]
                for b in range(own):
                    inner[a, b] += u * rows[0, b] + v * rows[1, b]
        for a in range(own):
            row = a + (here if a < POSE else there)
            out.pull_rest[row] += pull[a]
            for b in range(own):
                out.rest[row, b + (here if b < POSE else there)] += inner[a, b]


@inner
def _turning(by: Float64, arm: Float64, out: Float64) -> None:
    """Derive by a rotation vector: by (3,) times -[arm]_x."""
    out[0] = arm[1] * by[2] - arm[2] * by[1]
    out[1] = arm[2] * by[0] - arm[0] * by[2]
    out[2] = arm[0] * by[1] - arm[1] * by[0]


@compiled
def eliminate(
    equations: Equations, damping: float, inverses: Float64, reduced: Float64, pull: Float64
) -> None:
    """Eliminate the points: their damped inverse blocks (P, 3, 3) and the Schur complement.

    Of the complement the lower half is written, and its right-hand side.
    """
    size = len(pull)
    block, carried = np.empty((3, 3)), np.empty((3, size))
    for a in range(size):
        pull[a] = equations.pull_rest[a]
        for b in range(a + 1):
            reduced[a, b] = equations.rest[a, b]
        reduced[a, a] += damping * equations.rest[a, a] + 1e-12
    for p in range(len(inverses)):
        copy(equations.points[p], block)
        for i in range(3):
            block[i, i] += damping * equations.points[p, i, i]
        inverse(block, inverses[p])
        coupling = equations.coupling[p]
        for i in range(3):
            x, y, z = inverses[p, i, 0], inverses[p, i, 1], inverses[p, i, 2]
            for a in range(size):
                carried[i, a] = x * coupling[0, a] + y * coupling[1, a] + z * coupling[2, a]
        x, y, z = equations.pull_points[p]
        for a in range(size):
            pull[a] -= carried[0, a] * x + carried[1, a] * y + carried[2, a] * z
            u, v, w = coupling[0, a], coupling[1, a], coupling[2, a]
            row = reduced[a]
            for b in range(a + 1):
                row[b] -= u * carried[0, b] + v * carried[1, b] + w * carried[2, b]


@inner
def move(pose: Pose, points: Float64, rest: Float64, out: Pose) -> None:
    """Apply steps of the points (P, 3) and of the poses (7 G or more)."""
    turned = np.empty((3, 3))
    for p in range(len(points)):
        for i in range(3):
            out.points[p, i] = pose.points[p, i] + points[p, i]
    for g in range(len(pose.sizes)):
        step = rest[POSE * g : POSE * (g + 1)]
        rotation_from_vector_into(step[0], step[1], step[2], turned)
        product(turned, pose.rotations[g], out.rotations[g])
        for i in range(3):
            out.translations[g, i] = pose.translations[g, i] + step[3 + i]
        out.sizes[g] = pose.sizes[g] + min(max(step[6], -1.0), 1.0)


@inner
def descend(
    keypoints: Float64,
    weights: Float64,
    cameras: Cameras,
    mean: Float64,
    scale: float,
    shapes: Shapes,
    pose: Pose,
    iterations: int,
) -> float:
    """Find the optimum from `pose`, in place, by Levenberg-Marquardt; returns its cost."""
    best = cost_of(keypoints, weights, cameras, mean, scale, shapes, pose)
    if not math.isfinite(best):
        return best
    count, groups = len(pose.points), len(pose.sizes)
    size = POSE * groups + shapes.basis.shape[1]
    equations = make_equations(count, size)
    inverses, reduced = np.empty((count, 3, 3)), np.empty((size, size))
    step, points = np.empty(size), np.empty((count, 3))
    tried = make_pose(count, groups)
    damping, stale = FIRST_DAMPING, True
    for _ in range(iterations):
        if stale:
            linearise(keypoints, weights, cameras, mean, scale, shapes, pose, equations)
        eliminate(equations, damping, inverses, reduced, step)
        cost = np.inf
        if cholesky(reduced):
            cholesky_solve(reduced, step)
            back_substitute(equations, inverses, step, points)
            move(pose, points, step, tried)
            cost = cost_of(keypoints, weights, cameras, mean, scale, shapes, tried)
        stale = cost <= best
        if stale:
            gained = (best - cost) / max(best, 1e-9)
            copy_pose(tried, pose)
            best = cost
            damping = max(damping / 10, LEAST_DAMPING)
            if gained < CONVERGED:
                break
        else:
            damping *= 10
            if damping >= MOST_DAMPING:
                break
    return best


@inner
def back_substitute(
    equations: Equations, inverses: Float64, rest: Float64, points: Float64
) -> None:
    """Write the step of the points (P, 3) that belongs to that of the rest."""
    left = np.empty(3)
    for p in range(len(points)):
        for i in range(3):
            total = equations.pull_points[p, i]
            for a in range(len(rest)):
                total -= equations.coupling[p, i, a] * rest[a]
            left[i] = total
        for i in range(3):
            points[p, i] = (
                inverses[p, i, 0] * left[0]
                + inverses[p, i, 1] * left[1]
                + inverses[p, i, 2] * left[2]
            )
