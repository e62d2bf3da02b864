"""Keypoints that stay at one pixel while the subject moves: no detections.

A detector that loses a keypoint may go on writing the last place, or a corner such as (0, 0). Such
a place is repeated to the last digit, in frames that need not follow each other. Repetition alone
proves nothing. A planted foot whose coordinates were rounded stays too, and so does the root of a
figure that is kept in the middle. Rounded coordinates also repeat by chance. So two conditions
must hold: the neighbouring pixels are visited less often, and the keypoint must be moving, either
because another view shows it or because the subject leaves the place.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.extents import Extents, extents

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Figures: evidence/keypoints.md.
LEAST_REPEATS = 10  # frames; in real detections five that agree to the last digit were never seen
MOST_FROZEN = 1000  # places in a capture
MOST_PLACES = 10  # where one keypoint of a view is looked for, the most repeated first
LEAST_DIFFERENT = 0.25  # of a keypoint's places: a foot that is planted, again and again, has fewer
STEPS = 3  # of the grid that coordinates were rounded to, that a keypoint moves by at least
STEP_VALUES = 5000  # coordinates of a view from which the grid is found
ROUNDED = 0.8  # share of them that differ: fewer, and they were rounded
# In radii of what a view shows of the subject, see `extents`; a person's is a third of a metre:
MOVES = 0.01  # a keypoint whose median distance to its median place is larger moves
FAR_AWAY = 5.0  # a person's feet are three and a half from the middle
SHARED_AWAY = 2.0  # at the same pixel of several views: only what all views are centred on may be
GOES_AWAY = 4.0  # a foot that is planted sees the body pass by two and a half


class FrozenPlace(NamedTuple):
    """A pixel where keypoint p of view k is again and again."""

    k: int
    p: int
    pixel: tuple[float, float]
    frames: NDArray[np.int64]


def frozen_places(pixels: Float32, seen: Bool) -> list[FrozenPlace]:
    """Return the places that keypoints repeat although they must be moving.

    The result does not depend on the order of the frames.

    Parameters
    ----------
    pixels, seen
        (N, K, P, 2), and (N, K, P) whether each was observed.
    """
    places = list(_repeated_places(pixels, seen))
    if not places:
        return []
    shown = np.where(seen[..., None], pixels, np.float32(np.nan))
    steps = np.array([_step(shown[:, k]) for k in range(shown.shape[1])])  # (K,)
    there = extents(pixels, seen)
    suspect = [place for place in places if not _is_by_chance(place, shown, steps)]
    shared = Counter((place.p, place.pixel) for place in suspect)
    wrong = {
        place.pixel
        for place in suspect
        if _moves_elsewhere(place, shown, there, steps)
        or _is_left_alone(place, shown, there, steps, shared=shared[place.p, place.pixel] > 1)
    }
    # A pixel that a detector writes for "not found" means so in every view.
    found = [place for place in suspect if place.pixel in wrong]
    return sorted(found, key=lambda place: -len(place.frames))[:MOST_FROZEN]


def at_places(pixels: Float32, places: Float32, views: Sequence[int]) -> Bool:
    """Return which keypoints (N, K, P) of frames (N, K, P, 2) lie exactly at their frozen places.

    Parameters
    ----------
    places
        (M, 4) rows of view, keypoint, x, y.
    views
        Which view each of the K is, as the places count them.
    """
    there = np.zeros(pixels.shape[:3], np.bool_)
    index = {view: k for k, view in enumerate(views)}
    for view, p, x, y in places.tolist():
        k = index.get(int(view))
        if k is not None:
            there[:, k, int(p)] |= (pixels[:, k, int(p)] == np.array((x, y), np.float32)).all(-1)
    return there


def _step(shown: Float32) -> float:
    """Return the step of the grid to which coordinates (N, P, 2) were rounded, pixels; 0 if none.

    Coordinates are not rounded if among some thousands hardly two are equal.
    """
    values = shown[np.isfinite(shown)]
    if not len(values):
        return 0.0
    values = values[:: -(-len(values) // STEP_VALUES)]
    different = np.unique(values)
    if not 1 < len(different) < ROUNDED * len(values):
        return 0.0
    return float(np.median(np.diff(different)))


def _is_by_chance(place: FrozenPlace, shown: Float32, steps: Float64) -> bool:
    """Whether coordinates were rounded and the keypoint repeats this pixel by chance.

    Then it repeats it seldom, or visits the eight pixels around it about as often.
    """
    if not steps[place.k]:
        return False
    apart = np.abs(shown[:, place.k, place.p] - np.array(place.pixel, np.float32)).max(-1)
    count = len(place.frames)
    about = int((apart < 1.5 * steps[place.k]).sum())  # with itself
    return count < 2 * LEAST_REPEATS or about > 2 * count


def _repeated_places(pixels: Float32, seen: Bool) -> Iterator[FrozenPlace]:
    """Yield places that a keypoint of a view repeats exactly, at least `LEAST_REPEATS` times."""
    if len(pixels) < LEAST_REPEATS:
        return
    # Both coordinates of a keypoint as one integer: equal if and only if they are the same bits.
    keys = np.ascontiguousarray(pixels, np.float32).view(np.uint64)[..., 0]  # (N, K, P)
    ordered = np.sort(keys, axis=0)
    again = ordered[LEAST_REPEATS - 1 :] == ordered[: len(ordered) - LEAST_REPEATS + 1]
    for k, p in np.argwhere(again.any(0)).tolist():
        there = np.flatnonzero(seen[:, k, p])
        places, counts = np.unique(keys[there, k, p], return_counts=True)
        for index in np.argsort(-counts, kind="stable")[:MOST_PLACES]:
            if counts[index] >= LEAST_REPEATS:
                frames = there[keys[there, k, p] == places[index]]
                x, y = pixels[frames[0], k, p].tolist()
                yield FrozenPlace(k, p, (x, y), frames)


def _moves_elsewhere(place: FrozenPlace, shown: Float32, there: Extents, steps: Float64) -> bool:
    """Whether another view shows the keypoint moving in frames in which this one repeats it."""
    others = shown[place.frames, :, place.p]  # (F, K, 2)
    for k in range(others.shape[1]):
        known = others[np.isfinite(others[:, k, 0]), k]
        if k == place.k or len(known) < LEAST_REPEATS:
            continue
        different = len(np.unique(known, axis=0)) / len(known)
        if different > LEAST_DIFFERENT and _moves(known, k, there, steps):
            return True
    return False


def _moves(known: Float32, k: int, there: Extents, steps: Float64) -> bool:
    """Whether places (F, 2) of one keypoint in view k differ by more than rounding."""
    distances = np.linalg.norm(known - np.median(known, axis=0), axis=-1)
    return bool(np.median(distances) > MOVES * there.usual_radii[k] + STEPS * steps[k])


def _is_left_alone(
    place: FrozenPlace, shown: Float32, there: Extents, steps: Float64, *, shared: bool
) -> bool:
    """Whether the subject moves far from the place, or leaves it, in the same view."""
    n, k = place.frames, place.k
    offsets = (shown[n, k, place.p] - there.middles[n, k]) / there.usual_radii[k]  # (F, 2)
    offsets = offsets[np.isfinite(offsets[:, 0])]
    if len(offsets) < LEAST_REPEATS:
        return False
    others = (shown[n, k, p] for p in range(shown.shape[2]) if p != place.p)  # (F, 2) each
    known = (other[np.isfinite(other[:, 0])] for other in others)
    if not any(_moves(other, k, there, steps) for other in known if len(other)):
        return False
    passed = np.ptp(np.quantile(offsets, (0.05, 0.95), axis=0), axis=0).max()
    away = np.median(np.linalg.norm(offsets, axis=-1))
    return bool(away > (SHARED_AWAY if shared else FAR_AWAY) or passed > GOES_AWAY)
