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
    Track,
    choose_half_width,
    make_track,
    masked_median,
    motion_at,
)
from models.epipolar.fundamental import (
    LEAST_POINTS,
    fit_fundamentals,
    robust_costs,
    sampson_distances,
)
from models.epipolar.offset_refinement import (
    FLOOR,
    MOST_BLOCKS,
    Refined,
    TrackedFrames,
    costs_of_frames,
    count_blocks,
    refine_offsets,
)

Float64 = NDArray[np.float64]
Int = NDArray[np.int64]

REACH = 12  # frames that a view may be late or early if the frame rate is unknown
REACH_SECONDS = 1.0
MOST_REACH = 60  # frames
LEAST_FRAMES = 30  # with fewer nothing is estimated
MOST_FRAMES = 1500  # that are used, in windows of consecutive ones
MOST_PLACES = 200_000  # frames x views x keypoints that are used
WINDOWS = 8
WIDTH_VIEWS = 4  # that the width of the smoothing is chosen from
LEAST_BLOCKS = 6  # for a standard deviation
MOST_KEYPOINTS = 32
MOST_PAIRS = 24
SEARCH_POINTS = 1800  # of a pair, for whole offsets
STEPS = 12  # offsets tried on either side at a time
STARTS = 6  # of the search for whole offsets that suit all pairs
FILM = 0.7  # of the usual distance between poses: between frames of a film it is less
# A view is late if its offset is so many frames and standard deviations from 0, and perhaps late
# if it is so many.
LATE_FRAMES, LATE_SDS = 0.2, 4.0
HALVES_FRAMES = 2  # by which the halves of a short capture may differ from the whole
MOST_SD = 0.5  # frames: with more, the search may not have ended near the true offset
DOUBTFUL_FRAMES, DOUBTFUL_SDS = 0.5, 2.5
# Offsets are those of whole frames more often than not: taken as such within two standard
# deviations, or this many frames.
WHOLE_SDS, LEAST_WHOLE, MOST_WHOLE = 2.0, 0.02, 0.15
CHANGE_FRAMES, CHANGE_SDS = 0.5, 6.0  # of a drift or a jump
CHANGE_BLOCKS = 3  # of frames on either side of a jump
DRIFT = 0  # in place of the block before which a jump is
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
    doubtful: NDArray[np.bool_]  # (K,) perhaps


def find_timing(keypoints: Float64, weights: Float64, *, reach: int = REACH) -> Timing | None:
    """Find by how many frames the views of keypoints (N, K, P, 2) are late.

    Parameters
    ----------
    weights
        (N, K, P), 0 where not observed.
    reach
        Most frames between two views, to either side.

    Returns
    -------
    Timing or None
        None where keypoints are not informative: cameras that move, or too few frames. A view that
        shows too little is not late, with an infinite standard deviation.
    """
    views = keypoints.shape[1]
    shown = np.flatnonzero((weights > 0).sum((0, 2)) >= LEAST_FRAMES)
    if len(shown) < views:
        some = find_timing(keypoints[:, shown], weights[:, shown], reach=reach)
        return None if some is None else _among_all(some, shown, views)
    tracked = _track_frames(keypoints, weights, reach)
    if tracked is None:
        return None
    step = -(-reach // STEPS)
    whole = _search(tracked, np.zeros(views, np.int64), step)
    if step > 1:
        whole = _search(tracked, whole, 1)
    reference = int(np.argmin(np.abs(whole - np.median(whole))))
    start = (whole - whole[reference]).astype(np.float64)[:, None]
    # The search compares offsets on the same frames; from here on, all that views share count.
    tracked = tracked._replace(frames=_frames_within(tracked.tracks, int(np.abs(start).max())))
    found = refine_offsets(tracked, start, np.ones((len(tracked.frames), 1)), reference)
    if found is None or found.noise > MOST_NOISE * tracked.radius:
        return None
    changing = _find_change(tracked, found, reference)
    if changing is not None:
        return changing
    variances = found.covariances[:, 0, 0]
    sds = np.sqrt(np.where(variances >= 0, variances, np.inf))  # equal views have no information
    timing = _decide(np.zeros(1), found.coefficients.T, sds, tracked.blocks)
    if timing.late.any() and tracked.blocks < MOST_BLOCKS:
        return _unless_halves_differ(tracked, timing, reference, step)
    return timing


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


def _unless_halves_differ(
    tracked: TrackedFrames, timing: Timing, reference: int, step: int
) -> Timing:
    """Mark views of a short capture as doubtful unless both its halves agree."""
    agreed = np.ones(len(timing.late), np.bool_)
    for frames in np.array_split(tracked.frames, 2):
        whole = _search(tracked._replace(frames=frames), np.zeros(len(agreed), np.int64), step)
        apart = np.abs(whole - whole[reference] - timing.offsets[0])
        agreed &= apart <= max(HALVES_FRAMES, step)
    late = timing.late & agreed
    return timing._replace(late=late, doubtful=timing.doubtful | (timing.late & ~agreed))


def reach_at(fps: float | None) -> int:
    """Return how many frames to search on either side; the rate is in frames per second."""
    if fps is None:
        return REACH
    return int(np.clip(np.ceil(REACH_SECONDS * fps), REACH, MOST_REACH))


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


def _track_frames(keypoints: Float64, weights: Float64, reach: int) -> TrackedFrames | None:
    """Return the keypoints that are used, as tracks; None if they are too few."""
    count, views, _, _ = keypoints.shape
    chosen = np.sort(np.argsort(-(weights > 0).sum((0, 1)), kind="stable")[:MOST_KEYPOINTS])
    pixels, weights = keypoints[:, :, chosen], weights[:, :, chosen]
    seen = weights > 0
    reach = min(reach, count // 4)
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
    return TrackedFrames(tracks, _frames_within(tracks, reach), pairs, half_width)


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


def _search(tracked: TrackedFrames, centre: Int, step: int) -> Int:
    """Return the whole offsets (K,) around `centre`, in steps, that suit all pairs best."""
    shifts = step * np.arange(-STEPS, STEPS + 1)
    picked = _moving_frames(tracked)
    times = picked + shifts[:, None]  # (D, T)
    places = []
    for track, late in zip(tracked.tracks, centre, strict=True):
        needed, back = np.unique(times + late, return_inverse=True)
        motion = motion_at(track, needed.astype(np.float64), tracked.half_width)
        places.append(motion.places[back.reshape(times.shape)])  # (D, T, P, 2)
    costs = {}
    for first, second in tracked.pairs:
        profile = _profile(places[first][STEPS], places[second])
        if profile is not None:
            costs[first, second] = profile
    return centre + step * _best_for_all(costs, len(centre))


def _moving_frames(tracked: TrackedFrames) -> Int:
    """Return of every stretch of frames the one with most motion: without it there is no timing."""
    frames = tracked.frames.astype(np.float64)
    speeds = np.zeros(len(frames))
    for track in tracked.tracks:
        velocities = motion_at(track, frames, tracked.half_width).velocities
        speeds += np.linalg.norm(np.nan_to_num(velocities), axis=-1).mean(-1)
    keypoints = tracked.tracks[0].pixels.shape[1]
    count = min(len(frames), max(SEARCH_POINTS // keypoints, LEAST_FRAMES))
    stretches = np.array_split(np.arange(len(frames)), count)
    return tracked.frames[[stretch[np.argmax(speeds[stretch])] for stretch in stretches]]


def _profile(x: Float64, y: Float64) -> Float64 | None:
    """Mean cost (D,) of keypoints x (T, P, 2) with those of the other view at D offsets."""
    y = y.reshape(len(y), -1, 2)
    x = np.broadcast_to(x.reshape(1, -1, 2), y.shape)
    both = np.asarray(np.isfinite(x).all(-1) & np.isfinite(y).all(-1))
    if both.sum(1).min() < 3 * LEAST_POINTS:
        return None
    x, y = (np.where(both[..., None], points, 0.0) for points in (x, y))
    matrices, scales = fit_fundamentals(x, y, both.astype(np.float64), floor=FLOOR)
    distances = sampson_distances(matrices, x, y)
    costs = robust_costs(distances, scales[:, None]) * both
    return np.asarray(costs.sum(1) / both.sum(1), np.float64)


def _best_for_all(costs: dict[tuple[int, int], Float64], views: int) -> Int:
    """Return the steps (K,) of least cost over all pairs, by coordinate descent from some starts.

    Beyond the steps that were tried, a pair has the cost of its worst step.
    """
    best, least = np.zeros(views, np.int64), np.inf
    rng = np.random.default_rng(0)
    tried = np.arange(-STEPS, STEPS + 1)

    def cost_of(view: int, steps: Int) -> Float64:
        """Cost of the pairs of a view at each of the steps tried; without a pair none is best."""
        total = np.zeros(len(tried))
        for (first, second), profile in costs.items():
            if view in (first, second):
                ahead = tried - steps[first] if view == second else steps[second] - tried
                outside = np.abs(ahead) > STEPS
                total += np.where(
                    outside, profile.max(), profile[np.clip(ahead, -STEPS, STEPS) + STEPS]
                )
        return total if total.any() else np.abs(tried).astype(np.float64)

    for start in range(STARTS):
        steps = rng.integers(-STEPS // 2, STEPS // 2 + 1, views) * (start > 0)
        before = np.inf
        while True:
            now = 0.0
            for view in range(views):
                along = cost_of(view, steps)
                steps[view] = tried[np.argmin(along)]
                now += along.min()
            if now >= before:
                break
            before = now
        if before < least:
            best, least = steps.copy(), before
    return best - int(np.median(best))


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
    still = np.zeros(len(tracked.tracks), np.int64)
    parts = [
        _search(tracked._replace(frames=tracked.frames[side]), still, 1) for side in (~after, after)
    ]
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

    Standard deviations from few blocks are themselves uncertain. Student's t with one degree of
    freedom less than blocks has as much beyond 4 blocks / (blocks - 3) of its standard deviations
    as a Gaussian has beyond 4 (within 3 % for 6 to 16 blocks).
    """
    largest = np.abs(offsets).max(0)
    enough = LATE_SDS * blocks / (blocks - 3)
    late = (largest > LATE_FRAMES) & (largest > enough * sds) & (sds < MOST_SD)
    doubtful = ~late & (largest > DOUBTFUL_FRAMES) & (largest > DOUBTFUL_SDS * sds)
    nearest = np.round(offsets)
    near = np.abs(offsets - nearest) <= np.clip(WHOLE_SDS * sds, LEAST_WHOLE, MOST_WHOLE)
    kept = np.where(near & (len(frames) == 1), nearest, offsets)
    return Timing(frames, np.where(late | doubtful, kept, 0.0), sds, late, doubtful)
