"""Points that move, as rigid bones: what each joint's bones are at rest, and how the joint turns.

N frames of P joints; `parents` names the parent of each, every joint after its parent.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fewview.room import nearest_rotation

Float64 = NDArray[np.float64]

ROUNDS = 3  # of finding a joint's bones at rest: the first suits one frame, the others all
SCATTERED = 0.3  # of a bone's length: bones of a shorter mean point everywhere
UNTURNED = 1e-6  # weight of not turning at all, where bones leave it open
LEAST = 1e-12  # lengths below count as none


def posed(places: Float64, parents: Mapping[int, int | None]) -> tuple[Float64, Float64]:
    """Return the bones at rest (P, 3), from each joint's parent, and rotations (N, P, 3, 3).

    A rotation is relative to the parent's. In the room, that of a joint is the product of those
    from the root to it, and turns the bones that begin there.
    """
    frames, count, _ = places.shape
    rest = np.zeros((count, 3))
    turns = np.tile(np.eye(3), (frames, count, 1, 1))
    in_room = turns.copy()
    for joint, parent in parents.items():
        before = np.eye(3) if parent is None else in_room[:, parent]
        children = [child for child, its in parents.items() if its == joint]
        if children:
            bones = (places[:, children] - places[:, [joint]]) @ before  # in the parent's axes
            rest[children], turns[:, joint] = _rigid(bones)
        in_room[:, joint] = before @ turns[:, joint]
    return rest, turns


def _rigid(bones: Float64) -> tuple[Float64, Float64]:
    """Return what C bones (N, C, 3) of a joint are at rest (C, 3), and how they turn (N, 3, 3)."""
    lengths = np.median(np.linalg.norm(bones, axis=-1), axis=0)
    rest = bones.mean(0)
    if (np.linalg.norm(rest, axis=-1) < SCATTERED * lengths).any():
        rest = bones[0]
    for _ in range(ROUNDS):
        back = np.swapaxes(_turns(rest, bones), 1, 2)
        rest = np.einsum("nij,ncj->nci", back, bones).mean(0)
    rest = rest * (lengths / np.maximum(np.linalg.norm(rest, axis=-1), LEAST))[:, None]
    return rest, _turns(rest, bones)


def _turns(rest: Float64, bones: Float64) -> Float64:
    """Return the rotations (N, 3, 3) that take bones at rest (C, 3) nearest to those of frames.

    Kabsch (1978). What the bones leave open, such as the twist about a single one, is not turned.
    """
    crossed = np.einsum("nci,cj->nij", bones, rest)
    weight = UNTURNED * np.sqrt((bones**2).sum((1, 2)) * (rest**2).sum()) + LEAST
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
