"""All frames of a scene separately: costs, normal equations and optima, in threads."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame import cost_of, descend
from models.bundle.frame_equations import NormalEquations, equations_of_frame, linearise
from models.bundle.problem import (
    POSE,
    VIEW,
    Rig,
    Scene,
    ShapePrior,
    Views,
    contiguous,
    prior_of_frame,
    scene_of_frame,
    views_of_frame,
)
from models.numerics.compiled import compiled
from models.numerics.threads import empty_aligned, in_slices

Float64 = NDArray[np.float64]

FRAMES_AT_A_TIME = 16  # in one slice of a thread


def _in_slices(kernel: Callable[..., None], frames: int, *given: object) -> None:
    """Call a kernel with the first and last frame of each slice, in threads."""
    in_slices(frames, FRAMES_AT_A_TIME, lambda part: kernel(part.start, part.stop, *given))


def costs_of(views: Views, rig: Rig, prior: ShapePrior, scene: Scene) -> Float64:
    """Minus twice the log posterior of each frame (N,), up to a constant.

    Infinite where a point lies behind a camera.
    """
    views, scene, costs = contiguous(views), contiguous(scene), empty_aligned(len(scene.points))
    _in_slices(_costs, len(costs), views, rig, prior, scene, costs)
    return costs


@compiled
def _costs(
    start: int,
    stop: int,
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    costs: Float64,
) -> None:
    for n in range(start, stop):
        costs[n] = cost_of(
            views_of_frame(views, n), rig, prior_of_frame(prior, n), scene_of_frame(scene, n)
        )


def normal_equations(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, *, shared: bool
) -> NormalEquations:
    """Linearise every frame; with `shared`, also in the shared numbers (T = 11 K, else 0)."""
    views, scene = contiguous(views), contiguous(scene)
    frames, count, _ = scene.points.shape
    columns = POSE * rig.group_count + prior.basis.shape[1]
    columns += VIEW * len(rig.groups) if shared else 0
    equations = NormalEquations(
        empty_aligned(frames, count, 3, 3),
        empty_aligned(frames, count, 3, columns),
        empty_aligned(frames, columns, columns),
        empty_aligned(frames, count, 3),
        empty_aligned(frames, columns),
    )
    _in_slices(_linearise, frames, views, rig, prior, scene, equations)
    return equations


@compiled
def _linearise(
    start: int,
    stop: int,
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    out: NormalEquations,
) -> None:
    for n in range(start, stop):
        linearise(
            views_of_frame(views, n),
            rig,
            prior_of_frame(prior, n),
            scene_of_frame(scene, n),
            equations_of_frame(out, n),
        )


def adjust_frames(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene, *, iterations: int = 20
) -> tuple[Scene, Float64]:
    """Adjust every frame separately, with a fixed rig; return the scene and its costs (N,).

    A frame with a point behind a camera stays as it is, with an infinite cost.
    """
    views = contiguous(views)
    adjusted = Scene(*(array.copy(order="C") for array in scene))
    costs = empty_aligned(len(scene.points))
    _in_slices(_descend, len(costs), views, rig, prior, adjusted, iterations, costs)
    return adjusted, costs


@compiled
def _descend(
    start: int,
    stop: int,
    views: Views,
    rig: Rig,
    prior: ShapePrior,
    scene: Scene,
    iterations: int,
    costs: Float64,
) -> None:
    for n in range(start, stop):
        costs[n] = descend(
            views_of_frame(views, n),
            rig,
            prior_of_frame(prior, n),
            scene_of_frame(scene, n),
            iterations,
        )
