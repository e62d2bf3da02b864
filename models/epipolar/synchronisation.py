"""By how many frames views are late, estimated from keypoints alone, for static cameras.

All keypoints of a pair of static views obey one epipolar geometry if both views show the same
moment. For a view that is late by d frames this holds only if its keypoints are read d frames
later. The estimate is the offset whose best fundamental matrix leaves the least Sampson distances.
Only motion across the epipolar lines is informative.

Keypoints are smoothed as functions of time (`models.capture.tracks`). Whole offsets are tried for
every pair. The best choice for all pairs together is refined to a fraction of a frame by
`models.epipolar.offset_refinement`, which also computes standard errors.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.tracks import (
    HALF_WIDTHS,
    Motion,
    Track,
    choose_half_width,
    make_track,
    masked_median,
    motion_at,
)
from models.epipolar.coarse_offsets import Coarse, search
from models.epipolar.held_out_offsets import Offsets
from models.epipolar.offset_judgement import judge
from models.epipolar.offset_refinement import (
    Refined,
    TrackedFrames,
    costs_of_frames,
    count_blocks,
    refine_offsets,
)

Float64 = NDArray[np.float64]
Int = NDArray[np.int64]

LEAST_FRAMES = 30  # with fewer nothing is estimated
MOST_FRAMES = 1500  # that are used, in windows of consecutive ones
MOST_PLACES = 200_000  # frames x views x keypoints that are used
WINDOWS = 8
WIDTH_VIEWS = 4  # that the width of the smoothing is chosen from
LEAST_BLOCKS = 6  # for a standard deviation
MOST_KEYPOINTS = 32
MOST_PAIRS = 24
FILM = 0.7  # of the usual distance between poses: between frames of a film it is less
# A view is late if its offset is so many frames and standard deviations from 0, and perhaps late
# if it is so many.
LATE_FRAMES, LATE_SDS = 0.2, 4.0
MOST_SD = 0.5  # frames: with more, the search may not have ended near the true offset
DOUBTFUL_FRAMES, DOUBTFUL_SDS = 0.5, 2.5
# Offsets are those of whole frames more often than not: taken as such within two standard
# deviations, or this many frames.
WHOLE_SDS, LEAST_WHOLE, MOST_WHOLE = 2.0, 0.02, 0.15
CHANGE_FRAMES, CHANGE_SDS = 0.5, 6.0  # of a drift or a jump
CHANGE_BLOCKS = 3  # of frames on either side of a jump
MOST_JUMP = 12  # frames
DRIFT = 0  # in place of the block before which a jump is
MOST_SHIFT = 2.0  # frames, by a refinement: a jump may lie between
MOST_NOISE = 0.25  # of a view's radius: beyond it no one geometry explains the frames


class Timing(NamedTuple):
    """By how many frames each of K views is late, at M frames; between them it is interpolated.

    One of M for constant offsets; the first and the last for a drift; two neighbours for a jump.
    Offsets are relative to most of the views, or to the first of two.
    """

    frames: Float64  # (M,) rising
    offsets: Float64  # (M, K) in frames; view k shows in its frame n + offset what others do in n
    sds: Float64  # (K,) of the offset that is furthest from 0 in its standard deviations
    late: NDArray[np.bool_]  # (K,) certainly
    unknown: NDArray[np.bool_]  # (K,) whether they are, and by how much, keypoints leave open


def find_timing(keypoints: Float64, weights: Float64) -> Timing | None:
    """Find by how many frames the views of keypoints (N, K, P, 2) are late.

    Parameters
    ----------
    weights
        (N, K, P), 0 where not observed.

    Returns
    -------
    Timing or None
        None where there are too few frames or keypoints to compare views. A view that shows too
        little is not late, with an infinite standard deviation.
    """
    views = keypoints.shape[1]
    shown = np.flatnonzero((weights > 0).sum((0, 2)) >= LEAST_FRAMES)
    if len(shown) < views:
        some = find_timing(keypoints[:, shown], weights[:, shown])
        return None if some is None else _among_all(some, shown, views)
    tracked = _track_frames(keypoints, weights)
    if tracked is None:
        return None
    moments = np.arange(len(keypoints), dtype=np.float64)
    motions = [motion_at(track, moments, tracked.half_width) for track in tracked.tracks]
    coarse = search(motions, tracked.pairs)
    if coarse is None:
        return None
    timing = _refined(tracked, coarse)
    for view in range(views) if views > 2 else (1,):
        timing = _judged(tracked, timing, view, coarse)
    return timing


def _refined(tracked: TrackedFrames, coarse: Coarse) -> Timing:
    """Refine whole offsets by the geometry of static cameras, if they are static."""
    best: Refined | None = None
    for whole in {tuple(start): start for start in coarse.starts()}.values():
        start = whole.astype(np.float64)[:, None]
        reference = int(np.flatnonzero(whole == 0)[0])
        # The search compares offsets on the same frames; from here on, all that views share count.
        own = tracked._replace(frames=_frames_within(tracked.tracks, int(np.abs(whole).max())))
        found = refine_offsets(own, start, np.ones((len(own.frames), 1)), reference)
        if found is None or found.noise > MOST_NOISE * own.radius:
            continue
        if np.abs(found.coefficients - start).max() < MOST_SHIFT and (
            best is None or found.cost < best.cost
        ):
            best, used, fixed = found, own, reference
            if all(coarse.clear(view, whole) for view in range(len(whole))):
                break
    if best is None:
        late = coarse.offsets != 0
        none = np.zeros(len(late), np.bool_)
        return Timing(
            np.zeros(1),
            coarse.offsets[None].astype(np.float64),
            np.full(len(late), np.inf),
            late,
            none,
        )
    changing = _find_change(used, best, fixed)
    if changing is not None:
        return changing
    variances = best.covariances[:, 0, 0]
    sds = np.sqrt(np.where(variances >= 0, variances, np.inf))  # equal views have no information
    return _decide(np.zeros(1), best.coefficients.T, sds, used.blocks)


def _judged(tracked: TrackedFrames, timing: Timing, view: int, coarse: Coarse) -> Timing:
    """Keep, exchange or doubt the offset of a view."""
    moments = np.arange(len(tracked.tracks[0].pixels), dtype=np.float64)
    middle = timing.offsets.mean(0)
    own = np.interp(moments, timing.frames, timing.offsets[:, view])
    proposed = Offsets(view, own, middle)
    rivals = coarse.rivals(view, np.round(middle).astype(np.int64))
    judged = judge(tracked, middle, proposed, float(timing.sds[view]), rivals)
    offsets, late, unknown = timing.offsets.copy(), timing.late.copy(), timing.unknown.copy()
    sds = timing.sds.copy()
    late[view], unknown[view] = judged.verdict == "late", judged.verdict == "unknown"
    sds[view] = judged.sd
    if judged.verdict == "in step":
        offsets[:, view] = 0
    elif judged.offset is not own:
        offsets[:, view] = judged.offset[0]
    return Timing(timing.frames, offsets, sds, late, unknown)


def _among_all(timing: Timing, shown: Int, views: int) -> Timing:
    """Return the timing of all `views` from that of `shown` (S,), the views that show enough."""
    every = Timing(
        timing.frames,
        np.zeros((len(timing.frames), views)),
        np.full(views, np.inf),
        np.zeros(views, np.bool_),
        np.zeros(views, np.bool_),
    )
    for of_all, of_shown in zip(every[1:], timing[1:], strict=True):
        of_all[..., shown] = of_shown
    return every


def is_film(keypoints: Float64) -> bool:
    """Whether keypoints (N, K, P, 2) follow each other in time: poses change little by little."""
    if len(keypoints) < LEAST_FRAMES:
        return False
    apart = len(keypoints) // 3
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(np.diff(keypoints, axis=0), axis=-1)
        far = np.linalg.norm(keypoints[apart:] - keypoints[:-apart], axis=-1)
    between = [float(masked_median(array.ravel())) for array in (near, far)]
    return between[0] < FILM * between[1]


def _track_frames(keypoints: Float64, weights: Float64) -> TrackedFrames | None:
    """Return the keypoints that are used, as tracks; None if they are too few."""
    count, views, _, _ = keypoints.shape
    chosen = np.sort(np.argsort(-(weights > 0).sum((0, 1)), kind="stable")[:MOST_KEYPOINTS])
    pixels, weights = keypoints[:, :, chosen], weights[:, :, chosen]
    seen = weights > 0
    if views < 2 or count < LEAST_FRAMES:
        return None
    # One scale for all views keeps residuals of all pairs comparable.
    centres = np.stack([np.median(pixels[:, v][seen[:, v]], 0) for v in range(views)])
    centred = np.where(seen[..., None], pixels - centres[:, None], 0.0)
    extent = float(np.sqrt(np.square(centred[seen]).sum(-1).mean()))
    if extent <= 0:
        return None
    tracks = [make_track(centred[:, v] / extent, weights[:, v]) for v in range(views)]
    pairs = _choose_pairs(seen.sum((0, 2)))
    frames = _frames_within(tracks, 0)
    half_width = choose_half_width(
        tracks[:: -(-views // WIDTH_VIEWS)],
        [width for width in HALF_WIDTHS if count_blocks(len(frames), width) >= LEAST_BLOCKS],
    )
    if half_width is None:
        return None
    return TrackedFrames(tracks, frames, pairs, half_width)


def _frames_within(tracks: list[Track], margin: int) -> Int:
    """Return the frames at least `margin` from the ends, in windows if they are many."""
    count, keypoints, _ = tracks[0].pixels.shape
    frames = np.arange(margin, count - margin)
    most = int(np.clip(MOST_PLACES // (len(tracks) * keypoints), 10 * WINDOWS, MOST_FRAMES))
    if len(frames) <= most:
        return frames
    each = most // WINDOWS
    windows = np.array_split(frames, WINDOWS)
    return np.concatenate([w[(len(w) - each) // 2 :][:each] for w in windows])


def _choose_pairs(shown: Int) -> list[tuple[int, int]]:
    """Return all pairs of views that show so many keypoints (K,), or a few for every view."""
    views = range(len(shown))
    pairs = list(combinations(views, 2))
    if len(pairs) <= MOST_PAIRS:
        return pairs
    best = int(np.argmax(shown))
    next_to = {(view, view + 1) for view in views[:-1]}
    return sorted(next_to | {(min(v, best), max(v, best)) for v in views if v != best})


def _find_change(tracked: TrackedFrames, constant: Refined, reference: int) -> Timing | None:
    """Look for a drift, or for a jump as of dropped frames; None if offsets seem constant."""
    suspected = _suspect(constant.block_offsets, constant.block_weights)
    if suspected is None:
        return None
    first, last = float(tracked.frames[0]), float(tracked.frames[-1])
    if suspected == DRIFT:
        along = (tracked.frames - first) / (last - first)
        functions = np.stack((1 - along, along), 1)
        start = np.repeat(constant.coefficients, 2, axis=1)
        found, knots = refine_offsets(tracked, start, functions, reference), [first, last]
    else:
        border = int(tracked.frames[len(tracked.frames) * suspected // tracked.blocks])
        found = _with_jump(tracked, border, reference)
        if found is not None:  # the border between two blocks is only near the jump
            before, after = (
                costs_of_frames(tracked, found.matrices, offsets)
                for offsets in found.coefficients.T
            )
            border = int(tracked.frames[np.argmin(np.cumsum(before - after))]) + 1
            found = _with_jump(tracked, border, reference)
        knots = [border - 1.0, border]
    if found is None:
        return None
    changes = found.coefficients[:, 1] - found.coefficients[:, 0]
    variances = found.covariances[:, [0, 1], [0, 1]]  # (K, 2)
    sds = np.sqrt(np.maximum(variances.sum(1) - 2 * found.covariances[:, 0, 1], 0))
    if not (np.abs(changes) > np.maximum(CHANGE_FRAMES, CHANGE_SDS * sds)).any():
        return None
    return _decide(np.array(knots), found.coefficients.T, np.sqrt(variances.max(1)), tracked.blocks)


def _with_jump(tracked: TrackedFrames, border: int, reference: int) -> Refined | None:
    """Refine two constants for every view: before the frame `border`, and from it on."""
    after = tracked.frames >= border
    moments = np.arange(len(tracked.tracks[0].pixels), dtype=np.float64)
    motions = [motion_at(track, moments, tracked.half_width) for track in tracked.tracks]
    parts = []
    for side in (moments < border, moments >= border):
        kept = [Motion(*(np.where(side[:, None, None], a, np.nan) for a in m)) for m in motions]
        coarse = search(kept, tracked.pairs, MOST_JUMP)
        if coarse is None:
            return None
        parts.append(coarse.offsets)
    start = np.stack(parts, 1).astype(np.float64)  # (K, 2)
    functions = np.stack((~after, after), 1).astype(np.float64)
    return refine_offsets(tracked, start - start[reference], functions, reference)


def _suspect(offsets: Float64, weights: Float64) -> int | None:
    """Return the block before which a view seems to jump, `DRIFT` for a drift, None for neither.

    The offsets (B, K) of blocks are explained by a line, or by a step, by weighted least squares.
    """
    blocks = len(offsets)
    borders = range(CHANGE_BLOCKS, blocks - CHANGE_BLOCKS + 1)
    shapes = {at: (np.arange(blocks) >= at).astype(np.float64) for at in borders}
    shapes[DRIFT] = np.linspace(0.0, 1.0, blocks)
    best, most = None, CHANGE_SDS**2
    for late, weight in zip(offsets.T, weights.T, strict=True):
        if weight.sum() <= 0:
            continue
        centred = late - np.average(late, weights=weight)
        for kind, shape in shapes.items():
            column = shape - np.average(shape, weights=weight)
            power = float((weight * column**2).sum())
            if power <= 0:
                continue
            change = float((weight * column * centred).sum()) / power
            left = float((weight * (centred - change * column) ** 2).sum()) / (blocks - 2)
            certainty = change**2 * power / max(left, 1.0)
            if abs(change) > CHANGE_FRAMES / 2 and certainty > most:
                best, most = kind, certainty
    return best


def _decide(frames: Float64, offsets: Float64, sds: Float64, blocks: int) -> Timing:
    """Divide views into late, doubtful and in step; set the offsets of the last to 0.

    Standard deviations from few blocks are themselves uncertain. With B blocks, a t with B - 1
    degrees of freedom has at 4 B / (B - 3) sd the tail that a Gaussian has at 4 (within 3 % for 6
    to 16 blocks).
    """
    largest = np.abs(offsets).max(0)
    enough = LATE_SDS * blocks / (blocks - 3)
    late = (largest > LATE_FRAMES) & (largest > enough * sds) & (sds < MOST_SD)
    doubtful = ~late & (largest > DOUBTFUL_FRAMES) & (largest > DOUBTFUL_SDS * sds)
    nearest = np.round(offsets)
    near = np.abs(offsets - nearest) <= np.clip(WHOLE_SDS * sds, LEAST_WHOLE, MOST_WHOLE)
    kept = np.where(near & (len(frames) == 1), nearest, offsets)
    return Timing(frames, np.where(late | doubtful, kept, 0.0), sds, late, doubtful)
