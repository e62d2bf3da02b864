"""One frame's posterior, compiled: its cost, and its optimum.

`models.bundle.problem` defines the unknowns. All tuples are those of one frame: P keypoints, K
views, G groups, Q components, R = 7 G + Q unknowns besides the points.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import (
    OUTLIER,
    back_substitute,
    eliminate,
    linearise,
    make_equations,
    point_in_camera_into,
    point_in_group_into,
    whiten,
)
from models.bundle.problem import POSE, Rig, Scene, ShapePrior, Views
from models.numerics.compiled import inner
from models.numerics.matrices import cholesky, cholesky_solve, copy, product
from models.numerics.rotations import rotation_from_vector_into
from models.optics.lenses.projection import project_into

Float64 = NDArray[np.float64]

NEAREST_DEPTH = 1e-2  # units of the structure: no camera sees points nearer to it or behind it
# Levenberg-Marquardt: share of the diagonal that is added to it, and when to stop.
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
CONVERGED = 1e-6  # relative decrease of the cost


@inner
def make_scene(count: int, groups: int) -> Scene:
    """Return buffers for the unknowns of a frame."""
    return Scene(
        np.empty((count, 3)), np.empty((groups, 3, 3)), np.empty((groups, 3)), np.empty(groups)
    )


@inner
def copy_scene(source: Scene, target: Scene) -> None:
    """Copy the unknowns of a frame."""
    copy(source.points, target.points)
    copy(source.rotations, target.rotations)
    copy(source.translations, target.translations)
    copy(source.sizes, target.sizes)


@inner
def cost_of(views: Views, rig: Rig, prior: ShapePrior, scene: Scene) -> float:
    """Minus twice the log posterior, up to a constant; infinite with a point behind a camera."""
    turned, held, camera, pixel = np.empty(3), np.empty(3), np.empty(3), np.empty(2)
    keypoints, weights, lenses = views.keypoints, views.weights, rig.lenses
    total = 0.0
    for k in range(len(keypoints)):
        growth = math.exp(scene.sizes[rig.groups[k]])
        for p in range(len(scene.points)):
            w = weights[k, p]
            if w > 0:
                point_in_group_into(rig, scene, k, growth, p, turned, held)
                point_in_camera_into(rig, k, held, camera)
                if not camera[2] >= NEAREST_DEPTH:
                    return np.inf
                project_into(camera, lenses, k, pixel)
                squared = w * (
                    (pixel[0] - keypoints[k, p, 0]) ** 2 + (pixel[1] - keypoints[k, p, 1]) ** 2
                )
                if squared > OUTLIER**2:
                    squared = 2 * OUTLIER * math.sqrt(squared) - OUTLIER**2
                total += squared
    total += whiten(scene.points, prior, np.empty((len(scene.points), 3)))[0]
    for g in range(len(scene.sizes)):
        total += rig.size_precision[g] * scene.sizes[g] ** 2
    return total if math.isfinite(total) else np.inf


@inner
def apply_step(scene: Scene, points_step: Float64, others_step: Float64, out: Scene) -> None:
    """Write the unknowns after steps of the points (P, 3) and of the poses (7 G or more)."""
    rotation = np.empty((3, 3))
    for p in range(len(points_step)):
        for i in range(3):
            out.points[p, i] = scene.points[p, i] + points_step[p, i]
    for g in range(len(scene.sizes)):
        step = others_step[POSE * g : POSE * (g + 1)]
        rotation_from_vector_into(step[0], step[1], step[2], rotation)
        product(rotation, scene.rotations[g], out.rotations[g])
        for i in range(3):
            out.translations[g, i] = scene.translations[g, i] + step[3 + i]
        out.sizes[g] = scene.sizes[g] + min(max(step[6], -1.0), 1.0)


@inner
def descend(views: Views, rig: Rig, prior: ShapePrior, scene: Scene, iterations: int) -> float:
    """Find the optimum from `scene`, in place, by Levenberg-Marquardt; returns its cost.

    A scene whose cost is infinite stays as it is.
    """
    best = cost_of(views, rig, prior, scene)
    if not math.isfinite(best):
        return best
    count, groups = len(scene.points), len(scene.sizes)
    size = POSE * groups + prior.basis.shape[1]
    equations = make_equations(count, size)
    inverses, reduced = np.empty((count, 3, 3)), np.empty((size, size))
    step, points_step = np.empty(size), np.empty((count, 3))
    tried = make_scene(count, groups)
    damping, moved = FIRST_DAMPING, True
    for _ in range(iterations):
        if moved:
            linearise(views, rig, prior, scene, equations)
        eliminate(equations, damping, inverses, reduced, step)
        cost = np.inf
        if cholesky(reduced):
            cholesky_solve(reduced, step)
            back_substitute(equations, inverses, step, points_step)
            apply_step(scene, points_step, step, tried)
            cost = cost_of(views, rig, prior, tried)
        moved = cost <= best
        if moved:
            gained = (best - cost) / max(best, 1e-9)
            copy_scene(tried, scene)
            best = cost
            damping = max(damping / 10, LEAST_DAMPING)
            if gained < CONVERGED:
                break
        else:
            damping *= 10
            if damping >= MOST_DAMPING:
                break
    return best
