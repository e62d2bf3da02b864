"""Up, down, left and right of images: put right where it was asked, doubted where names say so."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from fewview.capture import Capture, Float64
from fewview.readers.views import View

HEADS = ("nose", "head", "eye", "ear", "neck", "snout", "chin", "mouth", "forehead")
FEET = ("ankle", "foot", "heel", "toe", "paw", "hoof")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")  # of left_ear, leftEar, LEar, LEFT_EAR
UPSIDE_DOWN = 0.9  # of the frames: so often a head is below the feet only where y counts upwards


def put_right(
    views: list[View], y: Literal["down", "up"], mirrored: Sequence[int], notes: list[str]
) -> list[View]:
    """Return the views with y downwards, and images as the cameras saw them."""
    out = []
    for index, view in enumerate(views):
        keypoints = view.keypoints
        for axis, turned, what in ((1, y == "up", "y"), (0, index in mirrored, "x")):
            if turned:
                keypoints = keypoints.copy()
                last = _last(view, axis)
                keypoints[..., axis] = last - keypoints[..., axis]
                notes.append(f"{view.name}: {what} is {last:g} minus what the file has")
        out.append(replace(view, keypoints=keypoints))
    return out


def _last(view: View, axis: int) -> float:
    """Return the last pixel of an axis: of the image, or that is seen if its size is unknown."""
    if view.image_size is not None:
        return view.image_size[axis] - 1.0
    return float(np.ceil(np.nanmax(view.keypoints[..., axis], initial=0)))


def doubts_of_sides(capture: Capture) -> list[str]:
    """Return a sentence if heads are below the feet in most cameras: y counts upwards then."""
    heads, feet = (_heights(capture, words) for words in (HEADS, FEET))
    if heads is None or feet is None:
        return []
    both = np.isfinite(heads) & np.isfinite(feet)
    below = [
        np.mean(heads[both[:, v], v] > feet[both[:, v], v]) > UPSIDE_DOWN
        for v in range(capture.views)
        if both[:, v].any()
    ]
    if not below or not any(below):
        return []
    names = capture.view_names or ()
    if all(below):
        return [
            "heads are below the feet in all cameras, as where y counts upwards from the lower "
            "edge, and then the result is a mirror image: say y='up' (--y up), unless the subject "
            "is upside down"
        ]
    where = [name for name, one in zip(names, below, strict=False) if one]
    return [
        f"{', '.join(where)}: heads are below the feet, and not in the other cameras: these images "
        "are upside down, or mirrored from top to bottom"
    ]


def _heights(capture: Capture, words: Sequence[str]) -> Float64 | None:
    """Return the median y (N, K) of the keypoints whose names have one of these words."""
    mine = [
        place
        for place, name in enumerate(capture.keypoint_names or ())
        if any(word.lower() in words for word in _WORD.findall(name))
    ]
    if not mine:
        return None
    y = np.where(capture.observed(), capture.keypoints[..., 1], np.nan)[:, :, mine]
    known = np.isfinite(y).any(-1)
    out = np.full(known.shape, np.nan)
    out[known] = np.nanmedian(y[known], axis=-1)
    return out
