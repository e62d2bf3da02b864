"""Explanations of one frame in perspective: starting points and their refinement, compiled.

Arrays are those of one frame: K views, P keypoints, G groups of the rig. Structures and poses are
in the frame of reference and the unit of the fit's shapes.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame import cost_of, descend, make_scene
from models.bundle.frame_equations import point_in_camera_into, whiten
from models.bundle.initial_poses import gather_frame, start_view
from models.bundle.known_structures import KnownStructures
from models.bundle.problem import (
    Rig,
    Scene,
    ShapePrior,
    Views,
    prior_about,
    stretch_of,
    stretch_x,
)
from models.lifting.skeleton_lengths import SkeletonLengths
from models.network.answers import Answers
from models.numerics.compiled import inner
from models.numerics.matrices import copy, fill, identity, product, total
from models.numerics.rotations import nearest_rotation_into
from models.optics.lenses.projection import project_into

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ITERATIONS = 12


class Refiner(NamedTuple):
    """Cameras of K views and the prior of the shapes they will see; see `make_refiner`."""

    rig: Rig
    apart: Rig  # the same lenses, every view moving on its own
    prior: ShapePrior  # its mean (P, 3) is the frame of reference of the shapes
    about_network: bool  # whether the prior is centred on the network's answers, or on the mean
    scales: Float64  # (V,) of the prior's spread with one view, two, ... V or more
    noise: float  # pixels
    unit: float  # a unit of the structure, in the user's unit
    held: SkeletonLengths  # in frames that two views or more show
    known: KnownStructures  # of the fit
    rejecting: bool  # whether keypoints that stray are left out


class Explanation(NamedTuple):
    """A structure and a perspective camera for every view."""

    points: Float64  # (P, 3)
    # (K, 3, 3) and (K, 3); the x axis of a stretched view is longer by the stretch of the frame
    rotations: Float64
    translations: Float64
    errors: Float64  # (K,) pixels, mean reprojection error


@inner
def make_explanation(count: int, views: int) -> Explanation:
    """Return an explanation of unwritten buffers."""
    return Explanation(
        np.empty((count, 3)), np.empty((views, 3, 3)), np.empty((views, 3)), np.empty(views)
    )


@inner
def copy_explanation(source: Explanation, target: Explanation) -> None:
    """Copy an explanation."""
    copy(source.points, target.points)
    copy(source.rotations, target.rotations)
    copy(source.translations, target.translations)
    copy(source.errors, target.errors)


@inner
def network_start_into(
    refiner: Refiner,
    answers: Answers,
    n: int,
    usable: Bool,
    mirrored: bool,
    start: Explanation,
    mean: Float64,
) -> None:
    """Compute perspective poses from the network's answer to frame n, and the prior's mean (P, 3).

    If `mirrored`, use the mirror image of the answer. Errors are not written.
    """
    count = len(mean)
    points, rotation, centre = np.empty((count, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(count):
        for i in range(3):
            points[p, i] = answers.points3d[n, p, i]
        if mirrored:
            points[p, 2] = -points[p, 2]
    scale = _align_into(points, refiner.prior.means, start.points, rotation, centre)
    copy(start.points if refiner.about_network else refiner.prior.means, mean)
    own, view_rotation, shift = np.empty((3, 3)), np.empty((3, 3)), np.empty(2)
    for k in range(len(usable)):
        if usable[k]:
            for i in range(3):
                for j in range(3):
                    own[i, j] = answers.rotations[n, k, i, j]
                    if mirrored and (i == 2) != (j == 2):
                        own[i, j] = -own[i, j]
            size = answers.scales[n, k]  # pixels per unit of the answer
            for i in range(2):
                shift[i] = answers.translations[n, k, i]
                for j in range(3):
                    shift[i] += size * own[i, j] * centre[j]
        else:  # harmless numbers
            identity(own)
            size = 1.0
            fill(shift, 0)
        product(own, rotation, view_rotation)
        start_view(
            refiner.rig,
            k,
            view_rotation,
            size / scale,
            shift,
            start.rotations[k],
            start.translations[k],
        )


@inner
def previous_start_into(
    refiner: Refiner, previous: Answers, n: int, mean: Float64, start: Explanation
) -> None:
    """Write the perspective answer of the previous frame, aligned to `mean` (P, 3)."""
    count, views, unit = len(mean), len(start.translations), refiner.unit
    earlier = make_explanation(count, views)
    for p in range(count):
        for i in range(3):
            earlier.points[p, i] = previous.points3d[n, p, i] / unit
    for k in range(views):
        if previous.camera_models[n, k] > 0:
            for i in range(3):
                earlier.translations[k, i] = previous.translations[n, k, i] / unit
                for j in range(3):
                    earlier.rotations[k, i, j] = previous.rotations[n, k, i, j]
        else:  # harmless numbers
            identity(earlier.rotations[k])
            for i in range(3):
                earlier.translations[k, i] = 1.0 if i == 2 else 0.0
    align_explanation_into(earlier, mean, start)


@inner
def align_explanation_into(explanation: Explanation, mean: Float64, out: Explanation) -> float:
    """Align an explanation to `mean` (P, 3) without changing what the cameras see.

    Returns the factor by which it is larger then. Errors are not written.
    """
    rotation, centre, shift = np.empty((3, 3)), np.empty(3), np.empty(3)
    scale = _align_into(explanation.points, mean, out.points, rotation, centre)
    for k in range(len(out.translations)):
        own = explanation.rotations[k]
        product(own, rotation, out.rotations[k])
        for i in range(3):
            shift[i] = explanation.translations[k, i]
            for j in range(3):
                shift[i] += own[i, j] * centre[j]
        for i in range(3):
            out.translations[k, i] = scale * shift[i]
    return scale


@inner
def continues(previous: Answers, n: int, usable: Bool) -> bool:
    """Whether all views that are usable have a perspective camera in the frame before."""
    if not len(previous.points3d):
        return False
    for k in range(len(usable)):
        if usable[k] and previous.camera_models[n, k] <= 0:
            return False
    return math.isfinite(previous.points3d[n, 0, 0])


@inner
def start_cost(
    refiner: Refiner, rig: Rig, views: Views, usable: Bool, mean: Float64, start: Explanation
) -> float:
    """Minus twice the log posterior of a start."""
    scene = make_scene(len(mean), len(rig.size_precision))
    _as_groups(rig, usable, start, scene)
    return cost_of(views, rig, _prior(refiner, usable, mean), scene)


@inner
def explain(
    refiner: Refiner,
    rig: Rig,
    views: Views,
    usable: Bool,
    mean: Float64,
    start: Explanation,
    out: Explanation,
) -> float:
    """Refine a start and write the outcome; returns minus twice the log posterior."""
    return explain_with(_prior(refiner, usable, mean), rig, views, usable, start, out)[0]


@inner
def explain_with(
    prior: ShapePrior, rig: Rig, views: Views, usable: Bool, start: Explanation, out: Explanation
) -> tuple[float, float]:
    """Refine a start with a prior and write the outcome.

    Returns minus twice the log posterior, and that of the prior alone, each up to a constant.
    """
    count = len(start.points)
    scene = make_scene(count, len(rig.size_precision))
    _as_groups(rig, usable, start, scene)
    cost = descend(views, rig, prior, scene, ITERATIONS)
    misfit, _ = whiten(scene.points, prior, np.empty((count, 3)))
    # Views that move on their own have size 1: their distance decides.
    size = 1.0 if rig.stretched[0] else math.exp(scene.sizes[0])
    for p in range(count):
        for i in range(3):
            out.points[p, i] = scene.points[p, i] * size
    for k in range(len(usable)):
        g = rig.groups[k]
        scale = math.exp(scene.sizes[g])
        growth = 1.0 if rig.stretched[k] else scale
        product(rig.rotations[k], scene.rotations[g], out.rotations[k])
        point_in_camera_into(rig, k, scene.translations[g], out.translations[k])
        for i in range(3):
            out.translations[k, i] *= size / growth
        if rig.stretched[k]:
            stretch_x(out.rotations[k], out.translations[k], scale)
    write_errors(rig, views, out)
    return cost, misfit


@inner
def write_errors(rig: Rig, views: Views, explanation: Explanation) -> None:
    """Write the mean reprojection error of each view."""
    points, camera, pixel = explanation.points, np.empty(3), np.empty(2)
    for k in range(len(explanation.errors)):
        rotation, translation = explanation.rotations[k], explanation.translations[k]
        summed, observed = 0.0, 0
        for p in range(len(points)):
            if views.weights[k, p] > 0:
                for i in range(3):
                    camera[i] = translation[i]
                    for j in range(3):
                        camera[i] += rotation[i, j] * points[p, j]
                project_into(camera, rig.lenses, k, pixel)
                summed += math.sqrt(
                    (pixel[0] - views.keypoints[k, p, 0]) ** 2
                    + (pixel[1] - views.keypoints[k, p, 1]) ** 2
                )
                observed += 1
        explanation.errors[k] = summed / max(observed, 1)


@inner
def _prior(refiner: Refiner, usable: Bool, mean: Float64) -> ShapePrior:
    """Return the prior of a frame: the more views it has, the narrower."""
    scale: float = refiner.scales[min(int(total(usable)), len(refiner.scales)) - 1]
    return prior_about(refiner.prior, mean, scale)


@inner
def _as_groups(rig: Rig, usable: Bool, start: Explanation, scene: Scene) -> None:
    """Compute the poses of the rig's groups from those of every view."""
    copy(start.points, scene.points)
    if len(scene.sizes) < len(usable):
        gather_frame(rig, start.rotations, start.translations, usable, scene)
    else:
        for k in range(len(usable)):
            g = rig.groups[k]
            copy(start.rotations[k], scene.rotations[g])
            copy(start.translations[k], scene.translations[g])
            stretch = stretch_of(scene.rotations[g]) if rig.stretched[k] else 1.0
            stretch_x(scene.rotations[g], scene.translations[g], 1 / stretch)
            scene.sizes[g] = math.log(stretch)


@inner
def _align_into(
    points: Float64, mean: Float64, aligned: Float64, rotation: Float64, centre: Float64
) -> float:
    """Align as `models.bundle.shape_model.align`: write the aligned points, Q and the centre.

    Returns the scale.
    """
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
    nearest_rotation_into(overlap, rotation)
    match = 0.0
    for i in range(3):
        for j in range(3):
            match += rotation[i, j] * overlap[i, j]
    scale = match / max(squared, 1e-12)
    for p in range(count):
        for i in range(3):
            rotated = 0.0
            for j in range(3):
                rotated += (points[p, j] - centre[j]) * rotation[j, i]
            aligned[p, i] = scale * rotated
    return scale
