"""Motions of many kinds, in two halves: constants are set on one, and the other is looked at.

Each motion gives points (N, P, 3) in metres with z up. Most are computed from a number. Others are
the ground truths of captures, or clips of a physics simulator (`pip download pybullet`; its folder
`pybullet_data/data/motions`), where their files are at hand.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]
Motion = Callable[[int, np.random.Generator], Float64]  # frames, rng -> points (N, P, 3)

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "three_actors.npz"
SETTING, LOOKING = HALVES = ("setting", "looking")
# Captures of each half, with the axis that points up, and clips.
CAPTURES = {
    SETTING: {"three_actors": 1, "cmu_mocap_virtual6": 1, "dannce_mouse1": 2},
    LOOKING: {"human36m": 2, "monkey": 1},
}
CLIPS = {
    SETTING: ("dance_a", "crawl", "kick", "getup_faceup", "cartwheel", "walk"),
    LOOKING: ("dance_b", "roll", "punch", "getup_facedown", "spinkick", "run", "jump"),
}
FPS = 50.0
HARMONICS = 8  # of a random course in time
SLOWEST, FASTEST = 0.1, 1.5  # cycles in a second

# The simulator's humanoid: name, parent, offset in metres (x ahead, y up, z right), and numbers of
# the joint: 4 of a quaternion, 1 of an angle about z, 0 of an end.
HUMANOID = (
    ("root", -1, (0.0, 0.0, 0.0), 4),
    ("chest", 0, (0.0, 0.236151, 0.0), 4),
    ("neck", 1, (0.0, 0.223894, 0.0), 4),
    ("right_hip", 0, (0.0, 0.0, 0.084887), 4),
    ("right_knee", 3, (0.0, -0.421546, 0.0), 1),
    ("right_ankle", 4, (0.0, -0.40987, 0.0), 4),
    ("right_shoulder", 1, (-0.02405, 0.2435, 0.18311), 4),
    ("right_elbow", 6, (0.0, -0.274788, 0.0), 1),
    ("left_hip", 0, (0.0, 0.0, -0.084887), 4),
    ("left_knee", 8, (0.0, -0.421546, 0.0), 1),
    ("left_ankle", 9, (0.0, -0.40987, 0.0), 4),
    ("left_shoulder", 1, (-0.02405, 0.2435, -0.18311), 4),
    ("left_elbow", 11, (0.0, -0.274788, 0.0), 1),
    ("head", 2, (0.0, 0.175, 0.03), 0),
    ("right_toe", 5, (0.15, -0.07, 0.0), 0),
    ("right_wrist", 7, (0.0, -0.258947, 0.0), 0),
    ("left_toe", 10, (0.15, -0.07, 0.0), 0),
    ("left_wrist", 12, (0.0, -0.258947, 0.0), 0),
)


def motions(
    half: str, data: Path | None = None, *, in_a_row: bool | None = None
) -> dict[str, Motion]:
    """Return the motions of a half by name; those of files in the folder `data` if it has them.

    Frames of captures are `in_a_row` or scattered; either if it is None.
    """
    found: dict[str, Motion] = {
        "skeleton": partial(skeleton, branching=half == SETTING),
        "seated": partial(seated, face=half == SETTING),
        "loose": partial(loose, waves=half == SETTING),
    }
    folder = data or ROOT
    for name, up in CAPTURES[half].items():
        file = EXAMPLE if name == EXAMPLE.stem else folder / f"{name}.npz"
        if file.exists():
            found[name] = partial(capture, file, up, in_a_row=in_a_row)
    for name in CLIPS[half]:
        file = folder / "motions" / f"humanoid3d_{name}.txt"
        if file.exists():
            found[f"clip {name}"] = partial(clip, file)
    return found


def chosen(found: dict[str, Motion], rng: np.random.Generator) -> str:
    """Draw the name of a motion: each kind is as likely, and all clips are one."""
    clips = [name for name in found if name.startswith("clip ")]
    kinds = [name for name in found if name not in clips] + ["clip"] * bool(clips)
    name = str(rng.choice(kinds))
    return str(rng.choice(clips)) if name == "clip" else name


def capture(
    file: Path,
    up: int,
    frames: int,
    rng: np.random.Generator,
    *,
    in_a_row: bool | None = None,
) -> Float64:
    """Take some frames of a capture's ground truth."""
    with np.load(file) as arrays:
        return taken(arrays["points3d"].astype(np.float64), up, frames, rng, in_a_row=in_a_row)[0]


def taken(
    truth: Float64,
    up: int,
    frames: int,
    rng: np.random.Generator,
    *,
    in_a_row: bool | None = None,
) -> tuple[Float64, bool]:
    """Return frames (N, P, 3) of a ground truth with z up, and whether they are in a row."""
    complete = np.flatnonzero(np.isfinite(truth).all(-1).mean(1) > 0.8)
    if in_a_row is None:
        in_a_row = bool(rng.random() < 0.6)
    if in_a_row:
        stride = int(rng.integers(1, max(2, len(complete) // frames)))
        span = min(frames * stride, len(complete))
        start = int(rng.integers(len(complete) - span + 1))
        chosen = complete[start : start + span : stride]
    else:
        chosen = np.sort(rng.permutation(complete)[:frames])
    return np.roll(truth[chosen], 2 - up, axis=2), in_a_row


def clip(file: Path, frames: int, rng: np.random.Generator) -> Float64:
    """Pose the simulator's humanoid as in a clip, from a random time on, over and over."""
    poses = np.array(json.loads(file.read_text())["Frames"])
    # As slow as the clip, so many frames: not the same ones again if it is long enough.
    rate = max(0.25, min(2.0, len(poses) / frames))
    at = (rng.uniform(0, len(poses)) + rate * np.arange(frames)) % (len(poses) - 1)
    low, share = at.astype(int), at % 1
    numbers = poses[low] + share[:, None] * (poses[low + 1] - poses[low])
    points = np.empty((frames, len(HUMANOID), 3))
    turns = np.empty((frames, len(HUMANOID), 3, 3))
    column = 4
    for joint, (_, parent, offset, count) in enumerate(HUMANOID):
        if parent < 0:
            points[:, joint], before = numbers[:, 1:4], np.eye(3)
        else:
            before = turns[:, parent]
            points[:, joint] = points[:, parent] + before @ offset
        turns[:, joint] = before @ _turned(numbers[:, column : column + count])
        column += count
    return points[..., [0, 2, 1]] * [1.0, -1.0, 1.0]


def skeleton(frames: int, rng: np.random.Generator, *, branching: bool) -> Float64:
    """Move a skeleton of random topology, each joint within limits of its own.

    `branching` grows limbs from a trunk; else from anywhere, so that chains are shorter.
    """
    joints = int(rng.integers(12, 36))
    parents = [-1]
    for joint in range(1, joints):
        if branching:  # mostly on from the last joint
            grown = rng.random() < 0.75
            parents.append(joint - 1 if grown else int(rng.integers(max(1, joint // 2))))
        else:
            parents.append(int(rng.integers(joint)))
    offsets = rng.standard_normal((joints, 3))
    offsets *= (np.exp(0.4 * rng.standard_normal(joints)) * 0.15 / np.linalg.norm(offsets, axis=1))[
        :, None
    ]
    limits = rng.uniform(0.05, 0.9, (joints, 3)) * (rng.random((joints, 3)) < 0.6)
    angles = limits * np.tanh(1.5 * courses(frames, (joints, 3), rng))
    turns = rotations_from_vectors(angles)  # (N, J, 3, 3)
    heading = np.zeros((frames, 3))
    heading[:, 2] = rng.uniform(0, 2.5) * courses(frames, (1,), rng)[:, 0]
    turns[:, 0] = rotations_from_vectors(heading) @ turns[:, 0]
    points = np.zeros((frames, joints, 3))
    for joint in range(1, joints):
        parent = parents[joint]
        points[:, joint] = points[:, parent] + turns[:, parent] @ offsets[joint]
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return points


def seated(frames: int, rng: np.random.Generator, *, face: bool) -> Float64:
    """Move what sits: shoulders, arms and two hands of 21 points, and a face or a head.

    Many keypoints move little each, and not all of it is along lines.
    """
    trunk = rotations_from_vectors(0.08 * courses(frames, (3,), rng))
    neck = trunk @ [0.0, 0.0, 0.5]
    head = trunk @ rotations_from_vectors(0.25 * courses(frames, (3,), rng))
    parts = [np.zeros((frames, 1, 3)), neck[:, None]]
    if face:
        around = np.linspace(0, np.pi, 17)
        jaw = np.stack((0.075 * np.cos(around), 0.05 * np.sin(around), -0.09 * np.sin(around)), 1)
        inner = rng.uniform([-0.05, 0.06, -0.05], [0.05, 0.1, 0.07], (25, 3))
        still = np.concatenate((jaw, inner)) + np.array([0, 0, 0.17])
        modes = 0.004 * rng.standard_normal((4, len(still), 3))
        shown = still + np.tensordot(courses(frames, (4,), rng), modes, 1)
    else:
        still = np.array([[0, 0.11, 0.16], [0.03, 0.1, 0.19], [-0.03, 0.1, 0.19]])
        still = np.concatenate((still, [[0.08, 0, 0.17], [-0.08, 0, 0.17], [0, 0, 0.27]]))
        shown = np.broadcast_to(still, (frames, *still.shape))
    parts.append(neck[:, None] + shown @ head.mT)
    for side in (-1.0, 1.0):
        shoulder = neck + trunk @ [0.18 * side, 0.0, -0.06]
        bend = 0.5 * np.tanh(courses(frames, (6,), rng))
        upper = trunk @ rotations_from_vectors(bend[:, :3] + [0.5, 0.0, 0.0])
        elbow = shoulder + upper @ [0.05 * side, 0.0, -0.29]
        lower = upper @ rotations_from_vectors(bend[:, 3:] + [1.3, 0.0, 0.0])
        wrist = elbow + lower @ [0.0, 0.0, -0.25]
        parts += [shoulder[:, None], elbow[:, None], _hand(wrist, lower, side, rng)]
    return np.concatenate(parts, 1)


def _hand(wrist: Float64, turn: Float64, side: float, rng: np.random.Generator) -> Float64:
    """Return a hand's 21 points (N, 21, 3): the wrist and four of each finger."""
    frames = len(wrist)
    palm = turn @ rotations_from_vectors(0.3 * courses(frames, (3,), rng))
    points = [wrist]
    for finger in range(5):
        spread = side * (finger - 2) * 0.16
        along = rotations_from_vectors(np.array([0.0, spread, 0.0]))
        bend = 0.45 + 0.4 * np.tanh(courses(frames, (1,), rng))
        place = wrist + palm @ (along @ [0.0, 0.0, -0.085 if finger else -0.04])
        points.append(place)
        for joint, length in enumerate((0.04, 0.025, 0.02)):
            angles = np.zeros((frames, 3))
            angles[:, 0] = bend[:, 0] * (joint + 1)
            place = place + palm @ along @ rotations_from_vectors(angles) @ [0.0, 0.0, -length]
            points.append(place)
    return np.stack(points, 1)


def loose(frames: int, rng: np.random.Generator, *, waves: bool) -> Float64:
    """Deform a body without rigid parts: by travelling waves, or by a smooth random field."""
    count = int(rng.integers(15, 50))
    still = rng.standard_normal((count, 3))
    still *= rng.uniform(0.7, 1, (count, 1)) / np.linalg.norm(still, axis=1, keepdims=True)
    still *= rng.uniform(0.3, 1.0, 3)
    amount = rng.uniform(0.08, 0.3)
    if waves:
        ways = rng.standard_normal((3, 3)) * 2
        speeds = rng.uniform(0.5, 4, 3)
        time = np.arange(frames) / FPS
        phases = still @ ways.T  # (P, 3)
        moves = np.sin(phases + speeds * time[:, None, None] + rng.uniform(0, 6, 3))
        shapes = still + amount * moves @ rng.standard_normal((3, 3))
    else:
        apart = np.square(still[:, None] - still).sum(-1)
        field = np.linalg.cholesky(np.exp(-apart / 0.3) + 1e-6 * np.eye(count))
        shapes = still + amount * np.einsum("pq,nqd->npd", field, courses(frames, (count, 3), rng))
    turn = rotations_from_vectors(rng.uniform(0.1, 1.5) * courses(frames, (3,), rng))
    return np.asarray(shapes @ turn.mT)


def courses(
    frames: int,
    shape: tuple[int, ...],
    rng: np.random.Generator,
    *,
    between: tuple[float, float] = (SLOWEST, FASTEST),
    fps: float = FPS,
) -> Float64:
    """Return random courses in time (N, *shape), smooth and of variance 1.

    Their rates lie `between` two, in cycles a second.
    """
    time = np.arange(frames) / fps
    low, high = np.log(between)
    rates = np.exp(rng.uniform(low, high, (HARMONICS, *shape)))
    phases = rng.uniform(0, 2 * np.pi, (HARMONICS, *shape))
    angles = 2 * np.pi * np.multiply.outer(time, rates) + phases
    return np.asarray(np.sin(angles).sum(1) * np.sqrt(2 / HARMONICS))


def _turned(numbers: Float64) -> Float64:
    """Return rotations (N, 3, 3) of quaternions (N, 4), scalar first, or angles (N, 1) about z."""
    if numbers.shape[1] == 4:
        real, axis = numbers[:, 0], numbers[:, 1:]
        norm = np.linalg.norm(axis, axis=1)
        angle = 2 * np.arctan2(norm, real)
        return rotations_from_vectors(axis * (angle / norm.clip(1e-12))[:, None])
    vectors = np.zeros((len(numbers), 3))
    if numbers.shape[1]:
        vectors[:, 2] = numbers[:, 0]
    return rotations_from_vectors(vectors)
