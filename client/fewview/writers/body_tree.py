"""The tree of joints of a body whose keypoints have the usual names, for formats that need one.

Detectors' edges leave the head apart, and join shoulders and hips in a circle. In a body, limbs
hang on the middle of the shoulders and of the hips, which are added where they are no keypoints.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fewview.animation import Animation
from fewview.readers.vision import usual as of_vision

_WORDS = re.compile(r"[A-Z]?[a-z]+\d*|[A-Z]+(?![a-z])\d*|\d+")
HIPS = ("hips", "pelvis", "mid_hip", "hip", "root")
NECK = ("neck", "thorax")
# Of each keypoint those that it may hang on, the first that is there; * is its side.
PARENTS: dict[str, tuple[str, ...]] = {
    "spine": HIPS,
    "thorax": ("spine", *HIPS),
    "neck": ("thorax", "spine", *HIPS),
    "nose": NECK,
    "head": NECK,
    "*_shoulder": ("thorax", "neck"),
    "*_elbow": ("*_shoulder",),
    "*_wrist": ("*_elbow",),
    "*_hip": HIPS,
    "*_knee": ("*_hip",),
    "*_ankle": ("*_knee",),
    "*_heel": ("*_ankle",),
    "*_big_toe": ("*_ankle",),
    "*_small_toe": ("*_ankle",),
    "*_foot_index": ("*_ankle",),
    "*_hand_wrist": ("*_wrist",),
    **dict.fromkeys(("*_pinky", "*_index", "*_thumb"), ("*_wrist",)),
    **dict.fromkeys(("*_eye", "*_ear", "*_eye_inner", "*_eye_outer", "mouth_*"), ("nose", "head")),
    **{
        f"*_hand_{finger}{joint}": (f"*_hand_{finger}{joint - 1}",)
        if joint > 1
        else ("*_hand_wrist",)
        for finger in ("thumb", "index", "middle", "ring", "pinky")
        for joint in (1, 2, 3, 4)
    },
    **dict.fromkeys((f"face_{place}" for place in range(68)), ("nose",)),
}
CENTRES = {
    "hips": HIPS,
    "neck": NECK,
}  # of hips and shoulders, and what they are called as keypoints
OF_CENTRES = {"hips": "*_hip", "neck": "*_shoulder"}


def with_body_tree(animation: Animation) -> Animation:
    """Return an animation whose edges are the tree of a body, with the joints that it lacks.

    One with other keypoints than a body's, or without both shoulders and hips, stays as it is.
    """
    names = [usual_name(name) for name in animation.names]
    place = {name: index for index, name in enumerate(names)}
    core = {each.replace("*", side) for each in OF_CENTRES.values() for side in ("left", "right")}
    if not core <= place.keys() or len(place) < len(names):
        return animation
    points, called = [animation.points], list(animation.names)
    for centre, known in CENTRES.items():
        if not place.keys() & set(known) and centre not in called:
            pair = [place[OF_CENTRES[centre].replace("*", side)] for side in ("left", "right")]
            points.append(animation.points[:, pair].mean(axis=1, keepdims=True))
            place[centre] = len(called)
            called.append(centre)
    edges = []
    for name, index in place.items():
        if name in HIPS:
            continue
        parent = next((place[each] for each in _parents(name) if each in place), None)
        if parent is None:
            return animation
        edges.append((parent, index))
    return replace(
        animation,
        points=np.concatenate(points, axis=1),
        points_sd=None,
        keypoint_names=tuple(called),
        edges=tuple(edges),
    )


def _parents(name: str) -> Iterator[str]:
    for side in ("left", "right"):
        for parent in PARENTS.get(name.replace(side, "*"), ()):
            yield parent.replace("*", side)


def usual_name(name: str) -> str:
    """Return a name such as ``LBigToe`` or ``Left Big Toe`` as ``left_big_toe``."""
    words: Sequence[str] = _WORDS.findall(of_vision(name))
    words = [{"L": "left", "R": "right"}.get(word, word.lower()) for word in words]
    return "_".join(words)
