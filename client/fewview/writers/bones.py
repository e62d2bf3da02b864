"""Moving points as rigid bones: the reference pose of each joint's bones, and its rotations.

N frames of P joints; `parents` names the parent of each, every joint after its parent.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fewview.geometry.rigs import nearest_rotation

Float64 = NDArray[np.float64]

ROUNDS = 3  # of estimating a joint's reference bones: the first from one frame, the others from all
SCATTERED = 0.3  # of a bone's length: bones of a shorter mean point everywhere
UNTURNED = 1e-6  # weight of not turning at all, where bones leave it open
LEAST = 1e-12  # lengths below count as none


def posed(places: Float64, parents: Mapping[int, int | None]) -> tuple[Float64, Float64]:
    """Return the reference bones (P, 3), from each joint's parent, and rotations (N, P, 3, 3).

    A rotation is relative to the parent's. In the room, that of a joint is the product of those
    from the root to it, and turns the bones that begin there.
    """
    frames, count, _ = places.shape
    reference = np.zeros((count, 3))
    turns = np.tile(np.eye(3), (frames, count, 1, 1))
    in_room = turns.copy()
    for joint, parent in parents.items():
        before = np.eye(3) if parent is None else in_room[:, parent]
        children = [child for child, its in parents.items() if its == joint]
        if children:
            bones = (places[:, children] - places[:, [joint]]) @ before  # in the parent's axes
            reference[children], turns[:, joint] = _rigid(bones)
        in_room[:, joint] = before @ turns[:, joint]
    return reference, turns


def _rigid(bones: Float64) -> tuple[Float64, Float64]:
    """Return the reference (C, 3) of C bones (N, C, 3) of a joint, and rotations (N, 3, 3)."""
    lengths = np.median(np.linalg.norm(bones, axis=-1), axis=0)
    reference = bones.mean(0)
    if (np.linalg.norm(reference, axis=-1) < SCATTERED * lengths).any():
        reference = bones[0]
    for _ in range(ROUNDS):
        back = np.swapaxes(turns_of(reference, bones), 1, 2)
        reference = np.einsum("nij,ncj->nci", back, bones).mean(0)
    reference = (
        reference * (lengths / np.maximum(np.linalg.norm(reference, axis=-1), LEAST))[:, None]
    )
    return reference, turns_of(reference, bones)


def turns_of(reference: Float64, bones: Float64) -> Float64:
    """Return the rotations (N, 3, 3) that take reference bones (C, 3) nearest to those of frames.

    Kabsch (1978). There is no rotation that the bones do not determine, such as the twist about a
    single one.
    """
    crossed = np.einsum("nci,cj->nij", bones, reference)
    weight = UNTURNED * np.sqrt((bones**2).sum((1, 2)) * (reference**2).sum()) + LEAST
    return nearest_rotation(crossed + weight[:, None, None] * np.eye(3))


def angles_of(turns: Float64) -> Float64:
    """Return angles (N, ..., 3) about Z, X, Y in degrees of rotations Rz Rx Ry (N, ..., 3, 3).

    They go on from frame to frame without jumps of whole turns.
    """
    x = np.arcsin(np.clip(turns[..., 2, 1], -1, 1))
    z = np.arctan2(-turns[..., 0, 1], turns[..., 1, 1])
    y = np.arctan2(-turns[..., 2, 0], turns[..., 2, 2])
    upright = np.hypot(turns[..., 0, 1], turns[..., 1, 1]) < 1e-9  # Z and Y turn about one axis
    z = np.where(upright, np.arctan2(turns[..., 1, 0], turns[..., 0, 0]), z)
    y = np.where(upright, 0, y)
    return np.degrees(np.unwrap(np.stack([z, x, y], -1), axis=0))
