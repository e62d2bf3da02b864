"""Scale by the body's height: as good as the body is like the average one."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fewview.room import Room

Float64 = NDArray[np.float64]

_NO_LETTER = re.compile(r"[^a-z]")
JOINTS = ("shoulder", "hip", "knee", "ankle")
# Of the height, standing: from the ankles (0.039) to the shoulders (0.818), joint to joint.
# Drillis and Contini, Body Segment Parameters, 1966, by Winter, Biomechanics, figure 4.1.
SHARE = 0.818 - 0.039
STRETCHED = 0.8  # quantile of the frames: most bend their trunk, and few are stretched by noise


def joints_of(names: Sequence[str] | None) -> list[list[int]]:
    """Return the keypoints of left and right of `JOINTS` (4, 2), by their names.

    Raises
    ------
    ValueError
        If one of them is not named.
    """
    plain = [_NO_LETTER.sub("", name.lower()) for name in names or ()]
    found = []
    for joint in JOINTS:
        sides = []
        for side in ("left", "right"):
            words = {f"{side}{joint}", f"{side[0]}{joint}", f"{joint}{side}", f"{joint}{side[0]}"}
            places = [place for place, name in enumerate(plain) if name in words]
            if not places:
                raise ValueError(
                    f"the height needs keypoints named shoulder, hip, knee and ankle of both "
                    f"sides: there is no {side}_{joint}; give the fit a "
                    "known length"
                )
            sides.append(places[0])
        found.append(sides)
    return found


def scaled_to(room: Room, height: float, names: Sequence[str] | None) -> Room:
    """Scale a room so that the body has its height; the error is a few percent, as bodies differ.

    The measured length is that of the chain from the middle of the shoulders over that of the hips
    along the legs to the ankles, in any pose. Head, neck and feet are left out, because detectors'
    keypoints do not reach their ends. The chain is the average share of an adult's height; children
    and animals have other shares.

    Raises
    ------
    ValueError
        If a joint is not named, or no frame shows them all.
    """
    joints = room.points[:, joints_of(names)]  # (N, 4, 2, 3)
    trunk = np.linalg.norm(joints[:, 0].mean(1) - joints[:, 1].mean(1), axis=-1)
    legs = np.linalg.norm(np.diff(joints[:, 1:], axis=1), axis=-1).sum(1).mean(1)
    lengths = trunk + legs
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        raise ValueError("the height needs a frame that shows shoulders, hips, knees and ankles")
    factor = SHARE * height / float(np.quantile(lengths, STRETCHED))
    return replace(
        room,
        points=factor * room.points,
        translations=factor * room.translations,
        scales=factor * room.scales,
        notes=(*room.notes, f"the unit is by the body's height {height:g}: a few percent unsure"),
    )
