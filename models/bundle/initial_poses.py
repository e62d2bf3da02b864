"""First guesses of perspective poses, from weak-perspective answers; compiled, frame by frame."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.adjustment import Rig, Scene
from models.bundle.frame import Cameras, Pose
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, inverse, product
from models.numerics.rotations import nearest_rotation_into, rotation_from_vector_into
from models.numerics.threads import room

Float64 = NDArray[np.float64]

WEAK = 1e-3  # pull to the mean of what the views say along their rays


def starting_scene(
    points: Tensor, rotations: Tensor, scales: Tensor, translations: Tensor, rig: Rig
) -> Scene:
    """Perspective poses of every view for weak-perspective answers, a group of one for each.

    (N, P, 3), (N, K, 3, 3), (N, K) and (N, K, 2) in pixels; the rig's extrinsics are not used.
    """
    cameras = rig.cameras(torch.zeros(rig.size))
    frames, views = scales.shape
    turned, shifts = room(frames, views, 3, 3), room(frames, views, 3)
    _start(
        cameras,
        np.ascontiguousarray(rotations.numpy(), np.float64),
        np.ascontiguousarray(scales.numpy(), np.float64),
        np.ascontiguousarray(translations.numpy(), np.float64),
        turned,
        shifts,
    )
    return Scene(
        points, torch.from_numpy(turned), torch.from_numpy(shifts), torch.zeros_like(scales)
    )


@compiled
def _start(
    cameras: Cameras,
    rotations: Float64,
    scales: Float64,
    translations: Float64,
    turned: Float64,
    shifts: Float64,
) -> None:
    for n in range(len(scales)):
        for k in range(scales.shape[1]):
            start_view(
                cameras,
                k,
                rotations[n, k],
                scales[n, k],
                translations[n, k],
                turned[n, k],
                shifts[n, k],
            )


@inner
def _length(vector: Float64) -> float:
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@inner
def start_view(
    cameras: Cameras,
    view: int,
    rotation: Float64,
    scale: float,
    translation: Float64,
    turned: Float64,
    shift: Float64,
) -> None:
    """Write R (3, 3) and t (3,) in perspective of one view seen with weak perspective."""
    lens = cameras.lenses
    x = (translation[0] - lens.centres[view, 0]) / lens.focals[view, 0]
    y = (translation[1] - lens.centres[view, 1]) / lens.focals[view, 1]
    # A camera that looks past the subject sees it turned by the angle it looks past.
    sine = math.sqrt(x * x + y * y)
    angle = math.atan(sine) / max(sine, 1e-12)
    past = np.empty((3, 3))
    rotation_from_vector_into(-y * angle, x * angle, 0.0, past)
    product(past, rotation, turned)
    depth = 0.5 * (lens.focals[view, 0] + lens.focals[view, 1]) / scale
    shift[0], shift[1], shift[2] = x * depth, y * depth, depth


def gather(scene: Scene, rig: Rig, seen: Tensor) -> Scene:
    """Turn poses of every view (a group for each) into poses of the rig's groups.

    A group's pose is the mean of what its views that are there, `seen` (N, K), say of it.
    """
    frames, size = len(scene.points), rig.size
    poses = Pose(
        np.ascontiguousarray(scene.points.numpy()),
        room(frames, size, 3, 3),
        room(frames, size, 3),
        room(frames, size),
    )
    _gather(
        rig.cameras(torch.zeros(size)),
        np.ascontiguousarray(scene.rotations.numpy()),
        np.ascontiguousarray(scene.translations.numpy()),
        np.ascontiguousarray(seen.numpy()),
        poses,
    )
    return Scene(*(torch.from_numpy(a) for a in poses))


@compiled
def _gather(
    cameras: Cameras,
    rotations: Float64,
    translations: Float64,
    seen: NDArray[np.bool_],
    poses: Pose,
) -> None:
    for n in range(len(seen)):
        gather_frame(
            cameras,
            rotations[n],
            translations[n],
            seen[n],
            poses.rotations[n],
            poses.translations[n],
            poses.sizes[n],
        )


@inner
def gather_frame(
    cameras: Cameras,
    rotations: Float64,
    translations: Float64,
    seen: NDArray[np.bool_],
    turned: Float64,
    shifts: Float64,
    sizes: Float64,
) -> None:
    """Write the poses (G, ...) of a frame's groups from those (K, ...) of its views."""
    mean, normal, solved = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    across, target, guess = np.empty((3, 3)), np.empty(3), np.empty(3)
    offset, centre = np.empty(3), np.empty(3)
    for g in range(len(sizes)):
        members, there, last = 0, 0, 0
        for k in range(len(seen)):
            if cameras.groups[k] == g:
                members, last = members + 1, k
                there += seen[k]
        fill(mean, 0)
        fill(normal, 0)
        fill(target, 0)
        fill(guess, 0)
        for k in range(len(seen)):
            if cameras.groups[k] != g or (there and not seen[k]):
                continue
            share = 1.0 / (there if there else members)
            outward = cameras.rotations[k]
            distance = _length(translations[k])
            for i in range(3):
                offset[i] = translations[k, i] - cameras.translations[k, i]
                for j in range(3):
                    ray = translations[k, i] * translations[k, j] / distance**2
                    across[i, j] = (1.0 if i == j else 0.0) - ray
            for i in range(3):
                for j in range(3):
                    for a in range(3):
                        mean[i, j] += share * outward[a, i] * rotations[k, a, j]
                        pulled = 0.0
                        for b in range(3):
                            pulled += across[a, b] * outward[b, j]
                        normal[i, j] += share * outward[a, i] * pulled
                for a in range(3):
                    pulled = 0.0
                    for b in range(3):
                        pulled += across[a, b] * cameras.translations[k, b]
                    target[i] -= share * outward[a, i] * pulled
                    guess[i] += share * outward[a, i] * offset[a]
        nearest_rotation_into(mean, turned[g])
        sizes[g] = 0.0
        if members == 1:
            copy(translations[last], shifts[g])
            continue
        # The point nearest to the rays to the structure, and the size that its depths say.
        for i in range(3):
            normal[i, i] += WEAK
            target[i] += WEAK * guess[i]
        inverse(normal, solved)
        for i in range(3):
            centre[i] = (
                solved[i, 0] * target[0] + solved[i, 1] * target[1] + solved[i, 2] * target[2]
            )
        copy(centre, shifts[g])
        for k in range(len(seen)):
            if cameras.groups[k] != g or (there and not seen[k]):
                continue
            squared = 0.0
            for i in range(3):
                at = cameras.translations[k, i]
                for j in range(3):
                    at += cameras.rotations[k, i, j] * centre[j]
                squared += at * at
            ratio = math.sqrt(squared) / _length(translations[k])
            sizes[g] += math.log(min(max(ratio, 0.1), 10.0)) / (there if there else members)
