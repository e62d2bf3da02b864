"""Views, sides and cameras that changed during a capture, for static cameras.

There are three such faults: views that were exchanged, left and right that were exchanged, and a
camera that was moved. They look alike: in each, some frames do not fit the epipolar geometry of the
others. So each is tried on the same frames. The one that explains them best is corrected, and the
others are tried on the remaining ones. If cameras move, no single geometry explains the frames, and
there are no findings.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.epipolar.left_right import LeftRightSwapped, find_left_right
from models.epipolar.moved_camera import MovedCamera, find_moved_camera
from models.epipolar.swapped_views import Reordered, find_swapped_views
from models.epipolar.view_pairs import SeenFrames, chosen_pairs, fit_pairs, seen_keypoints
from models.findings.finding import Finding

LEAST_FRAMES = 20
MOST_FAULTS = 3  # that one capture may have

Fault = Reordered | LeftRightSwapped | MovedCamera


def order_findings(
    keypoints: NDArray[np.floating],
    weights: NDArray[np.floating],
    *,
    late: Sequence[int] = (),
) -> tuple[Finding, ...]:
    """Find views that have changed places, left and right exchanged, and a camera that was moved.

    Parameters
    ----------
    keypoints, weights
        (N, K, P, 2) pixels and (N, K, P), 0 where not observed; frames in the order of filming,
        which only a moved camera needs.
    late
        Views that are known to be out of step: they are not tested for having been moved.
    """
    faults = _faults(seen_keypoints(keypoints, weights), late)
    return tuple(finding for fault in faults for finding in _findings_of(fault, len(keypoints)))


def put_in_order(
    keypoints: NDArray[np.floating], weights: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Undo exchanges, and leave out the smaller part of the frames of a camera that was moved.

    Parameters
    ----------
    keypoints, weights
        As for `order_findings`.

    Returns
    -------
    tuple or None
        (N, K, P', 2) and (N, K, P'), 0 and 1, of the keypoints that are seen most; None if nothing
        needs correction.
    """
    seen = seen_keypoints(keypoints, weights)
    faults = _faults(seen, ())
    for fault in faults:
        seen = _without(fault, seen) if isinstance(fault, MovedCamera) else fault.seen
    return (seen.pixels, seen.there.astype(np.float64)) if faults else None


def _without(moved: MovedCamera, seen: SeenFrames) -> SeenFrames:
    there = seen.there.copy()
    before = np.arange(len(there)) < moved.first
    lesser = before if before.mean() < 0.5 else ~before
    there[np.ix_(lesser, np.array(moved.views))] = False
    return seen._replace(there=there)


def _faults(seen: SeenFrames, late: Sequence[int]) -> list[Fault]:
    """Find one fault after the other, the one that explains most first."""
    faults: list[Fault] = []
    if len(seen.there) < LEAST_FRAMES or seen.there.shape[1] < 2:
        return faults
    while len(faults) < MOST_FAULTS and (fault := _worst(seen, late)) is not None:
        faults.append(fault)
        if isinstance(fault, MovedCamera):
            break  # frames before and after share no geometry with which to try the others
        seen = fault.seen
    return faults


def _worst(seen: SeenFrames, late: Sequence[int]) -> Fault | None:
    """Return the fault that explains the frames best, if any does."""
    pairs = chosen_pairs(seen)
    plain = fit_pairs(seen, pairs)
    if not plain:
        return None
    swapped = find_swapped_views(seen, pairs, plain)
    sided = find_left_right(seen, plain)
    moved = find_moved_camera(seen, plain)
    if moved is not None and set(moved.views) & set(late):
        moved = None
    faults = [fault for fault in (swapped, sided, moved) if fault is not None]
    return max(faults, key=lambda fault: fault.gain, default=None)


def _findings_of(fault: Fault, frames: int) -> list[Finding]:
    if isinstance(fault, Reordered):
        return [
            Finding.of(
                "views_swapped",
                views=swapped.views,
                frames=swapped.frames,
                share=swapped.frames.mean(),
                log_likelihood_ratio=swapped.ratio,
            )
            for swapped in fault.found
        ]
    if isinstance(fault, LeftRightSwapped):
        moved = fault.partners != np.arange(len(fault.partners))
        everywhere = bool(fault.frames.all())
        return [
            Finding.of(
                "left_right_swapped",
                views=fault.views,
                frames=() if everywhere else fault.frames,
                keypoints=fault.seen.keypoints[moved],
                share=fault.frames.mean(),
                log_likelihood_ratio=fault.gain,
            )
        ]
    return [
        Finding.of(
            "camera_moved",
            views=fault.views,
            frames=range(fault.first, frames),
            first_frame=fault.first,
            standard_errors=min(fault.sure, 1e6),
        )
    ]
