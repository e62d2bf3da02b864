"""What changed places or moved while the views were filmed, for cameras at rest.

Three harms look alike, for under each of them some frames do not suit the epipolar geometry of the
others: views that have changed places, left and right exchanged, and a camera that was moved. So
each is tried on the same frames. The one that explains them best is put right, and the others are
tried on what is left. Where cameras move, one geometry explains nothing, and nothing is said.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.epipolar.left_right import LeftRightSwapped, find_left_right
from models.epipolar.moved_camera import MovedCamera, find_moved_camera
from models.epipolar.swapped_views import Reordered, find_swapped_views
from models.epipolar.view_pairs import Seen, chosen_pairs, fit_pairs, seen_keypoints
from models.findings.finding import Finding

LEAST_FRAMES = 20
MOST_HARMS = 3  # that one capture may have


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
        Views that are known to be out of step: whether they were moved is not asked.
    """
    seen = seen_keypoints(keypoints, weights)
    if len(seen.there) < LEAST_FRAMES or seen.there.shape[1] < 2:
        return ()
    findings: list[Finding] = []
    for _ in range(MOST_HARMS):
        harm = _worst(seen, late)
        if harm is None:
            break
        findings += _said(harm, len(seen.there))
        if isinstance(harm, MovedCamera):
            break  # what lies before and after has no geometry in common to try the others with
        seen = harm.seen
    return tuple(findings)


def _worst(seen: Seen, late: Sequence[int]) -> Reordered | LeftRightSwapped | MovedCamera | None:
    """Return the harm that explains the frames best, if any does."""
    pairs = chosen_pairs(seen)
    plain = fit_pairs(seen, pairs)
    if not plain:
        return None
    swapped = find_swapped_views(seen, pairs, plain)
    sided = find_left_right(seen, plain)
    moved = find_moved_camera(seen, plain)
    if moved is not None and set(moved.views) & set(late):
        moved = None
    harms = [harm for harm in (swapped, sided, moved) if harm is not None]
    return max(harms, key=lambda harm: harm.gain, default=None)


def _said(harm: Reordered | LeftRightSwapped | MovedCamera, frames: int) -> list[Finding]:
    if isinstance(harm, Reordered):
        return [
            Finding.of(
                "views_swapped",
                views=swapped.views,
                frames=swapped.frames,
                share=swapped.frames.mean(),
                log_likelihood_ratio=swapped.ratio,
            )
            for swapped in harm.found
        ]
    if isinstance(harm, LeftRightSwapped):
        moved = harm.partners != np.arange(len(harm.partners))
        everywhere = bool(harm.frames.all())
        return [
            Finding.of(
                "left_right_swapped",
                views=harm.views,
                frames=() if everywhere else harm.frames,
                keypoints=harm.seen.keypoints[moved],
                share=harm.frames.mean(),
                log_likelihood_ratio=harm.gain,
            )
        ]
    return [
        Finding.of(
            "camera_moved",
            views=harm.views,
            frames=range(harm.first, frames),
            first_frame=harm.first,
            standard_errors=min(harm.sure, 1e6),
        )
    ]
