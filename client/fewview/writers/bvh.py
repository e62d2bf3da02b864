"""BVH, a skeleton in motion, where the edges join all keypoints as one tree.

A body whose keypoints have the usual names has the tree of `body_tree.py`, whatever its edges.

The root has channels of position and rotation, every other joint those of rotation alone, as tools
for animation expect. Bones are rigid: a bone's OFFSET has its median length over the frames, and a
joint with several bones keeps the angles between them that suit all frames best. So a point is off
by as much as the bones between it and the root differ from that.

Rotations are relative to the parent and, about a single bone, have no twist: the shortest rotation
from the reference bone. They are written in degrees about Z, X and Y: R = Rz Rx Ry.

BVH has no missing points: gaps are bridged in a straight line and held at both ends, and a keypoint
that is never seen lies on its parent. The unit is that of the points; the rate is constant.

Source: M. Meredith and S. Maddock, "Motion Capture File Formats Explained", Sheffield, 2001.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.body_tree import with_body_tree
from fewview.writers.bones import angles_of, posed
from fewview.writers.numbers import evened

Float64 = NDArray[np.float64]

_BLANKS = re.compile(r"\s+")
ROOT = re.compile(r"pelvis|mid_?hip|hips|root|hip", re.IGNORECASE)
ROTATION = "Zrotation Xrotation Yrotation"


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a skeleton in motion.

    Raises
    ------
    FormatError
        If its edges form no tree over all keypoints, its times are uneven, no keypoint is ever
        seen, or names are the same without their blanks.
    """
    animation = with_body_tree(evened(animation, "BVH"))
    names = [_BLANKS.sub("_", name.strip()) or "_" for name in animation.names]
    if len(set(names)) < len(names):
        raise FormatError("BVH has no blanks in names, and without them some are the same")
    if not animation.seen.any():
        raise FormatError("no point of the animation was ever seen")
    parents = _parents(animation)
    places = filled(animation.points, parents)
    offsets, turns = posed(places, parents)
    lines = ["HIERARCHY"]
    order: list[int] = []
    root = next(iter(parents))
    _write_joint(lines, order, root, parents, names, offsets)
    lines += ["MOTION", f"Frames: {len(places)}", f"Frame Time: {1 / animation.rate:.9g}"]
    angles = angles_of(turns)[:, order].reshape(len(places), -1)
    lines += [
        " ".join(f"{number:.9g}" for number in frame)
        for frame in np.hstack([places[:, root], angles]).tolist()
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def filled(points: Float64, parents: dict[int, int | None]) -> Float64:
    """Return points (N, P, 3) with gaps bridged, and the never seen on their parents."""
    places = points.copy()
    frames = np.arange(len(points))
    waiting = []
    for joint, parent in parents.items():
        there = np.isfinite(points[:, joint, 0])
        if there.any():
            for axis in range(3):
                places[:, joint, axis] = np.interp(
                    frames, frames[there], points[there, joint, axis]
                )
        elif parent is not None and np.isfinite(places[0, parent, 0]):
            places[:, joint] = places[:, parent]
        else:
            waiting.append(joint)
    if waiting:  # the root itself was never seen
        places[:, waiting] = np.nanmean(places, axis=1, keepdims=True)
    return places


def _parents(animation: Animation) -> dict[int, int | None]:
    """Return the parent of every keypoint, each after its parent, the root first.

    Of edges that close a circle, such as both hips to the pelvis and to each other, the last is
    left out.

    The root is a hip by its name, or else the middle of the tree.
    """
    names, count = animation.names, animation.points.shape[1]
    near: dict[int, list[int]] = {joint: [] for joint in range(count)}
    pieces = list(range(count))  # which keypoints hang together so far
    for first, second in dict.fromkeys((min(edge), max(edge)) for edge in animation.edges):
        if pieces[first] == pieces[second]:
            continue  # it closes a circle, and those before it join the same keypoints
        joined, taken = pieces[first], pieces[second]
        pieces = [joined if piece == taken else piece for piece in pieces]
        near[first].append(second)
        near[second].append(first)
    if len(set(pieces)) > 1:
        apart = ", ".join(names[joint] for joint in range(count) if pieces[joint] != pieces[0])
        raise FormatError(
            f"BVH needs edges that join all keypoints, {apart} are apart from {names[0]}; "
            "name the keypoints of a body as a known skeleton does, or give edges that join all"
        )
    walks = [_walk(near, joint) for joint in range(count)]
    depths = [depth for _, depth in walks]
    root = next(
        (joint for joint, name in enumerate(names) if ROOT.fullmatch(name)),
        int(np.argmin(depths)),
    )
    return walks[root][0]


def _walk(near: dict[int, list[int]], root: int) -> tuple[dict[int, int | None], int]:
    """Return the parents of all joints that are reached from a root, and how deep it goes."""
    parents: dict[int, int | None] = {root: None}
    front, depth = [root], 0
    while front:
        reached = []
        for joint in front:
            for other in near[joint]:
                if other not in parents:
                    parents[other] = joint
                    reached.append(other)
        front, depth = reached, depth + bool(reached)
    return parents, depth


def _write_joint(
    lines: list[str],
    order: list[int],
    joint: int,
    parents: dict[int, int | None],
    names: list[str],
    offsets: Float64,
    depth: int = 0,
) -> None:
    """Add a joint and what hangs on it to the lines, and to the order of the channels."""
    order.append(joint)
    pad = "  " * depth
    offset = " ".join(f"{number:.9g}" for number in (offsets[joint] if depth else np.zeros(3)))
    lines += [f"{pad}{'JOINT' if depth else 'ROOT'} {names[joint]}", f"{pad}{{"]
    channels = f"3 {ROTATION}" if depth else f"6 Xposition Yposition Zposition {ROTATION}"
    lines += [f"{pad}  OFFSET {offset}", f"{pad}  CHANNELS {channels}"]
    children = [child for child, parent in parents.items() if parent == joint]
    for child in children:
        _write_joint(lines, order, child, parents, names, offsets, depth + 1)
    if not children:
        lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0 0 0", f"{pad}  }}"]
    lines.append(f"{pad}}}")
