"""Subjects that move as a person and a mouse do, and cameras that see them as a detector would.

`practice.py` writes files of them. All is computed: metres, y up, and cameras in OpenCV's axes.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

UP = np.array([0.0, 1.0, 0.0])
EAR_TO_EAR = 0.018  # metres, of the mouse
ASTRAY = (15.0, 60.0)  # pixels, how far off a keypoint is that the detector does not see
GOOD = 12.0  # pixels: an error of this size has a confidence of 1 / e


class Subject(NamedTuple):
    """What moves, and the cameras before it.

    Attributes
    ----------
    points
        (N, P, 3) metres.
    fps
        Frames per second.
    """

    points: Float64
    fps: float
    names: tuple[str, ...]
    edges: tuple[tuple[str, str], ...]
    cameras: tuple["Camera", ...]


class Camera(NamedTuple):
    """A pinhole that looks at a point."""

    place: tuple[float, float, float]
    looks_at: tuple[float, float, float]
    focal: float  # pixels
    size: tuple[int, int]  # pixels

    def pose(self) -> tuple[Float64, Float64]:
        """Return the rotation (3, 3) and translation (3,) from the room to the camera."""
        ahead = np.subtract(self.looks_at, self.place)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, UP)
        right /= np.linalg.norm(right)
        rotation = np.stack((right, np.cross(ahead, right), ahead))
        return rotation, -rotation @ self.place

    def project(self, points: Float64) -> Float64:
        """Return pixels (..., 2) of points (..., 3)."""
        rotation, translation = self.pose()
        seen = points @ rotation.T + translation
        return np.asarray(seen[..., :2] / seen[..., 2:] * self.focal + np.divide(self.size, 2))


class Detections(NamedTuple):
    """What a detector makes of N frames of one camera."""

    keypoints: Float64  # (N, P, 2) pixels
    confidence: Float64  # (N, P) in [0, 1]
    hidden: NDArray[np.bool_]  # (N, P): not seen, so far off, at a low confidence


def detect(exact: Float64, rng: np.random.Generator, *, noise: float = 1.2) -> Detections:
    """See exact pixels (N, P, 2) as a detector would: noisy, and now and then far off."""
    shape = exact.shape[:2]
    hidden = rng.random(shape) < 0.01
    for shift in range(1, 6):  # what is hidden stays so for some frames
        hidden[shift:] |= hidden[:-shift] & (rng.random((shape[0] - shift, shape[1])) < 0.3)
    error = noise * rng.standard_t(5, exact.shape)
    angle = rng.uniform(0, 2 * np.pi, shape)
    jump = rng.uniform(*ASTRAY, shape)[..., None] * np.stack((np.cos(angle), np.sin(angle)), -1)
    error = np.where(hidden[..., None], jump, error)
    distance = np.linalg.norm(error, axis=-1)
    confidence = np.exp(-distance / GOOD) * rng.uniform(0.9, 1.0, shape)
    return Detections(exact + error, np.clip(confidence, 0.01, 1.0), hidden)


def person(frames: int, first: int = 0) -> Subject:
    """Return somebody of 1.75 m who walks in a figure of eight, in BODY_25's keypoints."""
    fps = 30.0
    time = np.arange(first, first + frames) / fps
    way = Way(lambda a: (1.3 * np.sin(a), 0.8 * np.sin(2 * a)))
    gone = 0.75 * time + 0.2 * np.sin(0.7 * time)
    middle, heading = way.at(gone)
    body = turns(heading, 0.08 + 0.06 * np.sin(1.1 * time), 0.05 * np.sin(2 * gone))
    pelvis = middle + 0.9 * UP
    neck = pelvis + body @ [0.0, 0.5, 0.0]
    head = body @ turns(0.6 * np.sin(0.8 * time), 0.2 * np.sin(1.3 * time), 0 * time)
    joints = {"MidHip": pelvis, "Neck": neck}
    for name, offset in {
        "Nose": (0.0, 0.14, 0.11),
        "LEye": (0.03, 0.17, 0.09),
        "LEar": (0.075, 0.15, 0.0),
    }.items():
        joints[name] = neck + head @ offset
        if name != "Nose":
            joints["R" + name[1:]] = neck + head @ (np.array(offset) * [-1, 1, 1])
    for side, sign in (("L", 1.0), ("R", -1.0)):
        feet = steps(way, gone, length=1.2, aside=0.11 * sign, late=0.0 if sign > 0 else 0.5)
        hip = pelvis + body @ [0.1 * sign, -0.02, 0.0]
        knee, ankle = limb(hip, feet.place + 0.08 * UP, (0.42, 0.41), feet.ahead)
        sole = ankle - 0.06 * UP
        aside = np.cross(UP, feet.ahead) * sign
        swing = 0.5 * np.sin(2 * np.pi * gone / 1.2 + (0.0 if sign > 0 else np.pi))
        wave = np.clip(2.6 * np.sin(0.45 * time + sign), 0, None)
        upper = body @ turns(0 * time, -swing - wave, 0.2 * sign + 0.1 * np.sin(0.9 * time + sign))
        shoulder = neck + body @ [0.18 * sign, -0.03, 0.0]
        elbow = shoulder + upper @ [0.0, -0.29, 0.0]
        fore = upper @ turns(0 * time, -0.5 - 0.4 * np.sin(0.7 * time) ** 2, 0 * time)
        joints |= {
            f"{side}Shoulder": shoulder,
            f"{side}Elbow": elbow,
            f"{side}Wrist": elbow + fore @ [0.0, -0.25, 0.0],
            f"{side}Hip": hip,
            f"{side}Knee": knee,
            f"{side}Ankle": ankle,
            f"{side}BigToe": sole + 0.17 * feet.ahead - 0.02 * aside,
            f"{side}SmallToe": sole + 0.14 * feet.ahead + 0.05 * aside,
            f"{side}Heel": sole - 0.05 * feet.ahead,
        }
    cameras = tuple(
        Camera((4.4 * np.sin(a), high, 4.4 * np.cos(a)), (0.0, 0.95, 0.0), focal, (1280, 720))
        for a, high, focal in ((0.3, 1.3, 900.0), (2.2, 2.1, 880.0), (4.3, 1.7, 940.0))
    )
    points = np.stack([joints[name] for name in BODY_25], axis=1)
    return Subject(points, fps, BODY_25, (), cameras)


def mouse(frames: int, first: int = 0) -> Subject:
    """Return a mouse in an open field, 40 cm wide, that runs, looks about and rears."""
    fps = 50.0
    time = np.arange(first, first + frames) / fps
    way = Way(lambda a: (0.12 * np.sin(a), 0.08 * np.sin(2 * a + 0.4)))
    gone = 0.11 * time + 0.025 * np.sin(1.9 * time)
    middle, heading = way.at(gone)
    rear = 0.9 * np.clip(np.sin(0.8 * time) - 0.55, 0, None) / 0.45  # now and then, on hind legs
    hind = turns(heading, -0.1 - 0.5 * rear, 0 * time)
    fore = turns(heading + 0.25 * np.sin(2.3 * time), -0.05 - rear, 0.1 * np.sin(3 * time))
    head = fore @ turns(
        0.5 * np.sin(1.7 * time), 0.25 + 0.4 * np.sin(1.3 * time), 0.2 * np.sin(2 * time)
    )
    tail_base = middle + 0.02 * UP - hind @ [0.0, 0.0, 0.028]
    spine = tail_base + hind @ [0.0, 0.008, 0.035]
    nape = spine + fore @ [0.0, 0.003, 0.032]
    joints = {
        "snout": nape + head @ [0.0, -0.004, 0.030],
        "left_ear": nape + head @ [EAR_TO_EAR / 2, 0.008, 0.008],
        "right_ear": nape + head @ [-EAR_TO_EAR / 2, 0.008, 0.008],
        "nape": nape,
        "spine": spine,
        "tail_base": tail_base,
    }
    tail = turns(heading + 0.5 * np.sin(1.5 * time), 0.15 * np.sin(1.1 * time), 0 * time)
    joints["tail_middle"] = tail_base + tail @ [0.0, -0.008, -0.04]
    for side, sign, late in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        for paw, root, forward, legs, turned, lift in (
            ("forepaw", nape, 0.034, (0.016, 0.016), fore, rear),
            ("hindpaw", tail_base, -0.012, (0.02, 0.022), hind, 0 * rear),
        ):
            shift = late + (0.25 if paw == "forepaw" else 0.0)
            feet = steps(way, gone + forward, length=0.06, aside=0.012 * sign, late=shift)
            body = root + turned @ [0.009 * sign, -0.006, 0.0]
            held = body + turned @ [0.0, -0.016, 0.014]
            share = np.clip(3 * lift, 0, 1)[:, None]
            _, end = limb(body, (1 - share) * feet.place + share * held, legs, feet.ahead)
            joints[f"{side}_{paw}"] = end
    cameras = tuple(
        Camera((0.5 * np.sin(a), high, 0.5 * np.cos(a)), (0.0, 0.02, 0.0), focal, (1024, 768))
        for a, high, focal in ((0.4, 0.34, 1150.0), (2.3, 0.28, 1080.0), (4.5, 0.42, 1210.0))
    )
    points = np.stack([joints[name] for name in joints], axis=1)
    return Subject(points, fps, tuple(joints), MOUSE_EDGES, cameras)


class Way:
    """A closed way on the floor, by how far one has gone on it."""

    def __init__(self, curve: Callable[[Float64], tuple[Float64, Float64]]) -> None:
        x, z = curve(np.linspace(0, 2 * np.pi, 2001))
        self._points = np.stack((x, 0 * x, z), axis=-1)
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=-1)
        self._gone = np.concatenate(([0.0], np.cumsum(lengths)))

    def at(self, gone: Float64) -> tuple[Float64, Float64]:
        """Return places (N, 3), and headings (N,) in radians about y, from z to x."""
        place, further = self._place(gone), self._place(gone + 0.01 * self._gone[-1])
        ahead = further - place
        return place, np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2]))

    def _place(self, gone: Float64) -> Float64:
        along = np.mod(gone, self._gone[-1])
        return np.stack([np.interp(along, self._gone, axis) for axis in self._points.T], axis=-1)


class Steps(NamedTuple):
    """Where a foot is, and where it points."""

    place: Float64  # (N, 3)
    ahead: Float64  # (N, 3) of length 1


def steps(way: Way, gone: Float64, *, length: float, aside: float, late: float) -> Steps:
    """Return a foot that stands still for six tenths of a step, and then swings to the next."""
    count, phase = np.divmod(gone / length + late, 1.0)
    share = np.clip((phase - 0.6) / 0.4, 0, 1)
    share = share * share * (3 - 2 * share)
    stands = []
    for number in (count, count + 1):
        place, heading = way.at((number + 0.3 - late) * length)
        left = np.stack((np.cos(heading), 0 * heading, -np.sin(heading)), axis=-1)
        stands.append(place + aside * left)
    place = stands[0] + share[:, None] * (stands[1] - stands[0])
    place[:, 1] += 0.12 * length * np.sin(np.pi * share)
    heading = way.at(gone)[1]
    return Steps(place, np.stack((np.sin(heading), 0 * heading, np.cos(heading)), axis=-1))


def limb(
    root: Float64, end: Float64, lengths: tuple[float, float], bends: Float64
) -> tuple[Float64, Float64]:
    """Return the middle joint and the end of two bones that reach from a root towards an end."""
    first, second = lengths
    reach = end - root
    far = np.linalg.norm(reach, axis=-1, keepdims=True)
    towards = reach / far
    far = np.clip(far, 1.001 * abs(first - second), 0.999 * (first + second))
    along = (first**2 - second**2 + far**2) / (2 * far)
    across = bends - towards * (bends * towards).sum(-1, keepdims=True)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    middle = root + towards * along + across * np.sqrt(first**2 - along**2)
    return middle, root + towards * far


def turns(yaw: Float64, pitch: Float64, roll: Float64) -> Float64:
    """Return rotations (N, 3, 3): about z first, then x, then y; a pitch above 0 leans forward."""
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)

    def about(first: int, second: int, angle: Float64) -> Float64:
        turned = np.stack([np.stack([one * (i == j) for j in range(3)], -1) for i in range(3)], -2)
        turned[:, first, first] = turned[:, second, second] = np.cos(angle)
        turned[:, first, second], turned[:, second, first] = -np.sin(angle), np.sin(angle)
        return turned + zero[:, None, None]

    return about(2, 0, yaw) @ about(1, 2, pitch) @ about(0, 1, roll)


BODY_25 = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist"),
    *("MidHip", "RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye"),
    *("REar", "LEar", "LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"),
)
MOUSE_EDGES = (
    *(("snout", "left_ear"), ("snout", "right_ear"), ("snout", "nape"), ("nape", "spine")),
    *(("spine", "tail_base"), ("tail_base", "tail_middle"), ("nape", "left_forepaw")),
    *(("nape", "right_forepaw"), ("tail_base", "left_hindpaw"), ("tail_base", "right_hindpaw")),
)
