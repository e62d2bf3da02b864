"""First guesses of perspective poses, from weak-perspective answers; compiled, frame by frame."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, Scene, contiguous, scene_of_frame
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, inverse, product
from models.numerics.rotations import nearest_rotation_into, rotation_from_vector_into
from models.numerics.threads import empty_aligned

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Weight of the mean of the views' positions along their rays, relative to that across them: it
# matters only where all rays are nearly parallel.
ALONG_RAYS = 1e-3
MOST_GROWTH = 10.0  # largest factor by which a view's depth may change the size of a group


class WeakPerspectiveScene(NamedTuple):
    """Weak-perspective answers for N frames of K views; any finite number for a missing view."""

    points: Float64  # (N, P, 3)
    rotations: Float64  # (N, K, 3, 3)
    scales: Float64  # (N, K) pixels per unit
    translations: Float64  # (N, K, 2) pixels


def starting_scene(weak: WeakPerspectiveScene, rig: Rig) -> Scene:
    """Perspective poses of every view for weak-perspective answers, a group of one for each.

    Only the lenses of the rig are used.
    """
    frames, views = weak.scales.shape
    rotations = empty_aligned(frames, views, 3, 3)
    translations = empty_aligned(frames, views, 3)
    _start(rig, contiguous(weak), rotations, translations)
    return Scene(weak.points, rotations, translations, np.zeros((frames, views)))


@compiled
def _start(rig: Rig, weak: WeakPerspectiveScene, rotations: Float64, translations: Float64) -> None:
    for n in range(len(weak.scales)):
        for k in range(weak.scales.shape[1]):
            start_view(
                rig,
                k,
                weak.rotations[n, k],
                weak.scales[n, k],
                weak.translations[n, k],
                rotations[n, k],
                translations[n, k],
            )


@inner
def start_view(
    rig: Rig,
    view: int,
    weak_rotation: Float64,
    scale: float,
    weak_translation: Float64,
    rotation: Float64,
    translation: Float64,
) -> None:
    """Compute R (3, 3) and t (3,) in perspective from one view's weak-perspective camera."""
    lenses = rig.lenses
    x = (weak_translation[0] - lenses.centres[view, 0]) / lenses.focals[view, 0]
    y = (weak_translation[1] - lenses.centres[view, 1]) / lenses.focals[view, 1]
    # A camera that points past the subject sees it rotated by the angle between.
    sine = math.sqrt(x * x + y * y)
    angle = math.atan(sine) / max(sine, 1e-12)
    past = np.empty((3, 3))
    rotation_from_vector_into(-y * angle, x * angle, 0.0, past)
    product(past, weak_rotation, rotation)
    depth = 0.5 * (lenses.focals[view, 0] + lenses.focals[view, 1]) / scale
    translation[0], translation[1], translation[2] = x * depth, y * depth, depth


def gather(scene: Scene, rig: Rig, seen: Bool) -> Scene:
    """Turn poses of every view (a group for each) into poses of the rig's groups.

    A group's pose is estimated from those of its views that are there, `seen` (N, K).
    """
    frames = len(scene.points)
    gathered = Scene(
        scene.points,
        empty_aligned(frames, rig.group_count, 3, 3),
        empty_aligned(frames, rig.group_count, 3),
        empty_aligned(frames, rig.group_count),
    )
    _gather(rig, contiguous(scene), np.ascontiguousarray(seen), contiguous(gathered))
    return gathered


@compiled
def _gather(rig: Rig, scene: Scene, seen: Bool, out: Scene) -> None:
    for n in range(len(seen)):
        gather_frame(
            rig, scene.rotations[n], scene.translations[n], seen[n], scene_of_frame(out, n)
        )


@inner
def gather_frame(
    rig: Rig, rotations: Float64, translations: Float64, seen: Bool, out: Scene
) -> None:
    """Write the poses of a frame's groups from those (K, 3, 3) and (K, 3) of its views.

    For each group two least-squares problems and a mean are solved: the rotation nearest to those
    of its views, the point nearest to their rays to the structure, and the size at which that point
    has their depths. The points of `out` stay as they are.
    """
    shares = np.empty(len(seen))
    for g in range(len(out.sizes)):
        members, last = _share_votes(rig, seen, g, shares)
        _mean_rotation_into(rig, rotations, shares, out.rotations[g])
        out.sizes[g] = 0.0
        if members == 1:
            copy(translations[last], out.translations[g])
        else:
            _nearest_point_to_rays_into(rig, translations, shares, out.translations[g])
            out.sizes[g] = _log_size(rig, translations, shares, out.translations[g])


@inner
def _share_votes(rig: Rig, seen: Bool, group: int, shares: Float64) -> tuple[int, int]:
    """Write the views' weights (K,) in a group's pose; return its number of views, and the last.

    The views that are there share equally; if none is, all of the group's do.
    """
    members, there, last = 0, 0, 0
    for k in range(len(seen)):
        if rig.groups[k] == group:
            members, last = members + 1, k
            there += seen[k]
    for k in range(len(seen)):
        votes = rig.groups[k] == group and (seen[k] or there == 0)
        shares[k] = 1.0 / (there if there else members) if votes else 0.0
    return members, last


@inner
def _mean_rotation_into(rig: Rig, rotations: Float64, shares: Float64, out: Float64) -> None:
    """Write the rotation R of a group nearest to C^T R_k of its views k (chordal mean)."""
    mean = np.empty((3, 3))
    fill(mean, 0)
    for k in range(len(shares)):
        if shares[k] > 0:
            for i in range(3):
                for j in range(3):
                    for a in range(3):
                        mean[i, j] += shares[k] * rig.rotations[k, a, i] * rotations[k, a, j]
    nearest_rotation_into(mean, out)


@inner
def _nearest_point_to_rays_into(
    rig: Rig, translations: Float64, shares: Float64, out: Float64
) -> None:
    """Write the point v (3,) of a group that minimises sum |A (C v + d)|^2 over its views.

    A = 1 - u u^T projects onto the plane across the view's ray u to the structure. The mean of
    C^T (t - d), the views' estimates of the structure's place, is a weak prior.
    """
    normal, inverted, across = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    target, mean = np.empty(3), np.empty(3)
    fill(normal, 0)
    fill(target, 0)
    fill(mean, 0)
    for k in range(len(shares)):
        if not shares[k] > 0:
            continue
        outward, ray = rig.rotations[k], translations[k]
        squared = length(ray) ** 2
        for i in range(3):
            for j in range(3):
                across[i, j] = (1.0 if i == j else 0.0) - ray[i] * ray[j] / squared
        for a in range(3):
            offset = ray[a] - rig.translations[k, a]
            across_d = 0.0  # (A d)_a
            for b in range(3):
                across_d += across[a, b] * rig.translations[k, b]
            for i in range(3):
                target[i] -= shares[k] * outward[a, i] * across_d
                mean[i] += shares[k] * outward[a, i] * offset
            for j in range(3):
                across_c = 0.0  # (A C)_aj
                for b in range(3):
                    across_c += across[a, b] * outward[b, j]
                for i in range(3):
                    normal[i, j] += shares[k] * outward[a, i] * across_c
    for i in range(3):
        normal[i, i] += ALONG_RAYS
        target[i] += ALONG_RAYS * mean[i]
    inverse(normal, inverted)
    for i in range(3):
        out[i] = (
            inverted[i, 0] * target[0] + inverted[i, 1] * target[1] + inverted[i, 2] * target[2]
        )


@inner
def _log_size(rig: Rig, translations: Float64, shares: Float64, centre: Float64) -> float:
    """Return the mean log ratio of a group's distance from its views to the views' estimates."""
    log_size = 0.0
    camera = np.empty(3)
    for k in range(len(shares)):
        if shares[k] > 0:
            for i in range(3):
                camera[i] = rig.translations[k, i]
                for j in range(3):
                    camera[i] += rig.rotations[k, i, j] * centre[j]
            ratio = length(camera) / length(translations[k])
            log_size += shares[k] * math.log(min(max(ratio, 1 / MOST_GROWTH), MOST_GROWTH))
    return log_size


@inner
def length(vector: Float64) -> float:
    """Return the length of a vector (3,)."""
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
