"""Up, down, left and right of images: corrected if asked for, reported if names contradict them.

Keypoints are named left and right, and toes and heels. A camera above the feet sees the toes of a
person who faces it below the heels, and their left on the right; both are the other way round from
behind. In a mirrored image, or with y upwards, one of the two is wrong.
"""

import re
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Capture, Float32, Float64
from fewview.readers.large_arrays import blocks
from fewview.readers.matching import epipolar_misfit
from fewview.readers.views import View, with_keypoints

HEADS = ("nose", "head", "eye", "ear", "neck", "snout", "chin", "mouth", "forehead")
FEET = ("ankle", "foot", "heel", "toe", "paw", "hoof")
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")  # of left_ear, leftEar, LEar, LEFT_EAR
SIDES = {"left": "right", "l": "r", "right": "left", "r": "l"}
UPSIDE_DOWN = 0.9  # of the frames: so often a head is below the feet only where y counts upwards
CONTRADICTED = -0.2  # correlation; unmirrored it is hardly ever below 0
TURNING = 0.06  # of the visible height: a person who never turns does not determine sides
FEWEST = 20  # frames that must show what an image is judged by
# Of the correlation of as many values as feet swing: of drawn people who walk before true images,
# 2 in 100 contradicted their names in 30 frames at 1.5, none at 2.
CHANCE = 2.0


def counted_from(
    views: Sequence[View], corners: Sequence[tuple[float, float] | None], notes: list[str]
) -> list[View]:
    """Return the views with pixels of the whole image, where they count from a crop's corner."""
    for view, corner in zip(views, corners, strict=True):
        if corner is None or corner == (0, 0):
            continue
        for block in blocks(view.keypoints):  # read for this capture alone: changed in place
            view.keypoints[block] += np.array(corner, np.float32)
        notes.append(f"{view.name}: counted from ({corner[0]:g}, {corner[1]:g}); put right")
    return list(views)


def put_right(
    views: list[View], y: Literal["down", "up"], mirrored: Sequence[int], notes: list[str]
) -> list[View]:
    """Return the views with y downwards, and images as the cameras saw them.

    A detector that was run on the mirrored image calls the left hand right. The other views decide
    whether it was: in a mirrored view, names are exchanged if they then fit better.
    """
    out = []
    for index, view in enumerate(views):
        keypoints = view.keypoints  # read for this capture alone: changed in place
        for axis, turned, what in ((1, y == "up", "y"), (0, index in mirrored, "x")):
            if turned:
                # A mirror in the image of other views has their right edge.
                shared = view.mirrored and view.image_size is None
                last = max(_last(v, axis) for v in (views if shared else [view]))
                for block in blocks(keypoints):
                    keypoints[block][..., axis] = last - keypoints[block][..., axis]
                notes.append(f"{view.name}: {what} is {last:g} minus what the file has")
        out.append(view)
    for index in mirrored:
        other = next((v for v in range(len(out)) if v not in mirrored), None)
        order = opposite_names(out[index].keypoint_names or ())
        if order is not None and (other is None or _fits_exchanged(out[index], out[other], order)):
            out[index] = with_keypoints(out[index], order)
            notes.append(
                f"{out[index].name}: left and right were exchanged, as its image is mirrored"
            )
    return out


def opposite_names(names: Sequence[str]) -> NDArray[np.intp] | None:
    """Return of each keypoint (P,) that of the other side, itself if it has none; None of none."""
    words = [[word.lower() for word in _WORD.findall(name)] for name in names]
    place = {tuple(each): index for index, each in enumerate(words)}
    order = [
        place.get(tuple(SIDES.get(word, word) for word in each), index)
        for index, each in enumerate(words)
    ]
    return None if order == list(range(len(names))) else np.array(order, np.intp)


def _fits_exchanged(view: View, other: View, order: NDArray[np.intp]) -> bool:
    """Whether a view fits another better with left and right exchanged, or as well."""
    if view.keypoints.shape[2] != other.keypoints.shape[2]:
        return True
    _, i, j = np.intersect1d(view.numbers, other.numbers, return_indices=True)
    mine, theirs = view.keypoints[i, 0].astype(float), other.keypoints[j, 0].astype(float)
    kept, exchanged = epipolar_misfit(mine, theirs), epipolar_misfit(mine[:, order], theirs)
    return kept is None or exchanged is None or exchanged <= kept


def _last(view: View, axis: int) -> float:
    """Return the last pixel of an axis: of the image, or that is seen if its size is unknown."""
    if view.image_size is not None:
        return view.image_size[axis] - 1.0
    most = max(
        (
            np.nanmax(view.keypoints[block][..., axis], initial=0)
            for block in blocks(view.keypoints)
        ),
        default=0.0,
    )
    return float(np.ceil(most))


def doubts_of_sides(capture: Capture) -> list[str]:
    """Return sentences on images that seem to be upside down or mirrored, by their keypoints."""
    return _upside_down(capture) or _mirrored(capture)


def _mirrored(capture: Capture) -> list[str]:
    """Return a sentence on cameras in which toes contradict left and right."""
    evidence = [_names_hold(capture, view) for view in range(capture.views)]
    against = [v for v, held in enumerate(evidence) if held is not None and held < CONTRADICTED]
    if not against:
        return []
    views = capture.view_names or tuple(map(str, range(capture.views)))
    which = ",".join(views[v] for v in against)
    if len(against) == sum(held is not None for held in evidence) > 1:
        return [
            "in all cameras, toes point the other way than the names left and right imply: the "
            "images are mirrored, or names were exchanged, and the result is a mirror image: give "
            f"mirror='{which}' (--mirror {which}) if the images are mirrored"
        ]
    return [
        f"{which}: toes point the other way than the names left and right imply, and not in the "
        f"other cameras, as in a mirrored image: give mirror='{which}' (--mirror {which})"
    ]


def _names_hold(capture: Capture, view: int) -> float | None:
    """Return how toes and heels agree with left and right, from -1 to 1; None if they cannot.

    It is the correlation over the frames of how far toes are below heels, and of how far left is to
    the right: what feet do in every step is in it but once. In a few steps it may be chance: what
    of the toes does not go with the sides swings with the feet, and each swing is one value.
    """
    names = capture.keypoint_names or ()
    words = [{word.lower() for word in _WORD.findall(name)} for name in names]
    opposite = opposite_names(names)
    if opposite is None:
        return None
    left = [k for k, parts in enumerate(words) if parts & {"left", "l"} and opposite[k] != k]
    toes_there = [k for k, word in enumerate(words) if "toe" in word or {"foot", "index"} <= word]
    heels_there = {
        frozenset(parts & SIDES.keys()): k for k, parts in enumerate(words) if "heel" in parts
    }
    feet = [(toe, heels_there.get(frozenset(words[toe] & SIDES.keys()))) for toe in toes_there]
    pairs = [(toe, heel) for toe, heel in feet if heel is not None]
    if not left or not pairs:
        return None
    toes, heels = map(list, zip(*pairs, strict=True))
    across, below, heights = np.empty((3, capture.frames))
    for block in blocks(capture.keypoints, capture.confidence):
        shown = _shown(capture, block, view)
        across[block] = _means(shown[:, left, 0] - shown[:, opposite[left], 0])
        below[block] = _means(shown[:, toes, 1] - shown[:, heels, 1])
        y = shown[..., 1]
        heights[block] = np.fmax.reduce(y, axis=1) - np.fmin.reduce(y, axis=1)
    known = np.isfinite(below) & np.isfinite(across)
    if known.sum() < FEWEST:
        return None
    turned = across[known].std() > TURNING * float(np.median(heights[known]))
    if not turned or not below[known].std() > 0:
        return None
    aside, down = (values[known] - values[known].mean() for values in (across, below))
    apart = down - aside * (aside @ down) / (aside @ aside)
    swings = np.count_nonzero(np.diff(apart > 0)) + 1
    held = float(np.corrcoef(aside, down)[0, 1])
    return held if held**2 * swings > CHANCE**2 else None


def _shown(capture: Capture, block: slice, view: int | slice = slice(None)) -> Float32:
    """Return the keypoints of a block of frames, NaN where they were not observed."""
    observed = capture.observed_in(block)[:, view, ..., None]
    return np.where(observed, capture.keypoints[block, view], np.float32(np.nan))


def _means(values: Float32) -> Float64:
    """Return the mean of each row (N,) over what is known of it, NaN of nothing."""
    known = np.isfinite(values)
    total = np.where(known, values, 0).sum(1)
    return np.asarray(np.where(known.any(1), total / np.maximum(known.sum(1), 1), np.nan))


def _upside_down(capture: Capture) -> list[str]:
    """Return a sentence if heads are below the feet in most cameras: y counts upwards then."""
    heads, feet = (_heights(capture, words) for words in (HEADS, FEET))
    if heads is None or feet is None:
        return []
    both = np.isfinite(heads) & np.isfinite(feet)
    below = [
        np.mean(heads[both[:, v], v] > feet[both[:, v], v]) > UPSIDE_DOWN
        for v in range(capture.views)
        if both[:, v].sum() >= FEWEST
    ]
    if not below or not any(below):
        return []
    names = capture.view_names or tuple(map(str, range(capture.views)))
    if all(below):
        return [
            "heads are below the feet in all cameras, as where y counts upwards from the lower "
            "edge, and then the result is a mirror image: give y='up' (--y up), unless the subject "
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
    out = np.full((capture.frames, capture.views), np.nan)
    for block in blocks(capture.keypoints, capture.confidence):
        y = _shown(capture, block)[:, :, mine, 1]
        known = np.isfinite(y).any(-1)
        out[block][known] = np.nanmedian(y[known], axis=-1)
    return out
