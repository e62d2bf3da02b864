"""The bones of a body as VMC has them: names, parents and axes of Unity's humanoid.

Points have y up and are right-handed. The T pose looks along -z, so its left arm
points along -x. Unity is left-handed: its z is the other way round.

Source: the VirtualMotionCapture protocol, https://protocol.vmc.info/english.html
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fewview.calibration.camera import quaternion
from fewview.errors import FormatError
from fewview.live.holding import Pose
from fewview.writers.body_tree import CENTRES, OF_CENTRES, usual_name
from fewview.writers.bones import LEAST, turns_of

Float64 = NDArray[np.float64]
Direction = tuple[float, float, float]

LEFT, UP, DOWN, AHEAD = (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
TOES = (0.0, -0.4, -0.9)  # from an ankle, which is above the sole
_SIDES = ("left", "right")
PAIRS = {**OF_CENTRES, "ears": "*_ear"}  # points in the middle of two


class Bone(NamedTuple):
    """A bone, the bone that it hangs on, and directions between points in the T pose."""

    name: str
    parent: str | None
    directions: tuple[tuple[str, str, Direction], ...]


def _limbs(side: str) -> tuple[Bone, ...]:
    """Return the bones of an arm and a leg, each after the one that it hangs on."""
    name, out = side.capitalize(), LEFT if side == "left" else (1.0, 0.0, 0.0)
    chain = (
        ("UpperArm", "Spine", "shoulder", "elbow", out),
        ("LowerArm", "UpperArm", "elbow", "wrist", out),
        ("UpperLeg", "Hips", "hip", "knee", DOWN),
        ("LowerLeg", "UpperLeg", "knee", "ankle", DOWN),
        ("Foot", "LowerLeg", "ankle", "big_toe", TOES),
        ("Foot", "LowerLeg", "ankle", "foot_index", TOES),
    )
    return tuple(
        Bone(
            f"{name}{bone}",
            parent if parent in {"Spine", "Hips"} else f"{name}{parent}",
            ((f"{side}_{start}", f"{side}_{end}", unbent),),
        )
        for bone, parent, start, end, unbent in chain
    )


BONES = (
    Bone("Hips", None, (("right_hip", "left_hip", LEFT), ("hips", "neck", UP))),
    Bone("Spine", "Hips", (("right_shoulder", "left_shoulder", LEFT), ("hips", "neck", UP))),
    Bone("Head", "Spine", (("right_ear", "left_ear", LEFT), ("ears", "nose", AHEAD))),
    Bone("Head", "Spine", (("neck", "head", UP),)),
    *_limbs("left"),
    *_limbs("right"),
)


class Turned(NamedTuple):
    """A bone's rotation from its parent, and where it is if it is the first (metres)."""

    name: str
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]  # x, y, z, w


class Body:
    """Which keypoints make which bones; bones whose keypoints are absent are left out.

    Raises
    ------
    FormatError
        On making it: the keypoints do not have the names of both shoulders and both hips.
    """

    def __init__(self, names: Sequence[str]) -> None:
        usual = [usual_name(name) for name in names]
        self._places = {name: [place] for place, name in enumerate(usual)}
        needed = [pair.replace("*", side) for pair in OF_CENTRES.values() for side in _SIDES]
        if lacking := [name for name in needed if name not in self._places]:
            raise FormatError(
                f"VMC needs keypoints that are named {', '.join(lacking)}; send points without "
                "bones with --to osc:// or udp+json://, or fit with keypoint names"
            )
        for centre, pair in PAIRS.items():
            both = [name for side in _SIDES if (name := pair.replace("*", side)) in self._places]
            known = [name for name in CENTRES.get(centre, ()) if name in self._places]
            if len(both) == len(_SIDES):
                found = known[:1] or both
                self._places[centre] = [place for name in found for place in self._places[name]]
        self._bones: dict[str, Bone] = {}
        for bone in BONES:
            ends = {end for *pair, _ in bone.directions for end in pair}
            if ends <= self._places.keys():
                self._bones.setdefault(bone.name, bone)

    def turned(self, pose: Pose, metres: float) -> list[Turned]:
        """Return the bones of a pose; `metres` is what its unit is in metres.

        A bone that fades turns back to the T pose. One that is gone is left out, and so are
        those that hang on it.
        """
        found, in_room = [], dict[str, Float64]()
        for bone in self._bones.values():
            before = np.eye(3) if bone.parent is None else in_room.get(bone.parent)
            weight = min(self._weight(pose, end) for *pair, _ in bone.directions for end in pair)
            if before is None or not weight:
                continue
            along = [self._at(pose, b) - self._at(pose, a) for a, b, _ in bone.directions]
            unbent = np.array([direction for *_, direction in bone.directions])
            turn = turns_of(_unit(unbent), _unit(np.array(along)) @ before[None])[0]
            in_room[bone.name] = before @ turn
            x, y, z = self._at(pose, "hips") * metres if bone.parent is None else np.zeros(3)
            found.append(Turned(bone.name, (x, y, 0.0 - z), _in_unity(turn, weight)))
        return found

    def _at(self, pose: Pose, name: str) -> Float64:
        return np.asarray(pose.points[self._places[name]].mean(0))

    def _weight(self, pose: Pose, name: str) -> float:
        return float(pose.weights[self._places[name]].min())


def _unit(vectors: Float64) -> Float64:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, LEAST))


def _in_unity(turn: Float64, weight: float) -> tuple[float, float, float, float]:
    """Return a share of a rotation (3, 3) as a quaternion x, y, z, w in axes with z reversed."""
    w, x, y, z = quaternion(turn)
    half = float(np.arccos(np.clip(w, -1, 1)))
    share = np.sin(weight * half) / np.sin(half) if half > LEAST else weight
    return (-x * share, -y * share, z * share, float(np.cos(weight * half)))
