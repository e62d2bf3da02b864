"""A static camera that was moved at some frame: one geometry before it, another from there on.

Two matrices for a pair of views always explain more than one, if only because the subject is
elsewhere later. The sign of a moved camera is a jump. With matrices fitted to frames well before
and well after it, frames just before the move fit the first ones and frames just after it the
others, although the subject is still at the same place.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.fundamental import Fundamental
from models.epipolar.view_pairs import (
    DEPENDENCE,
    TINY,
    Matrices,
    SeenFrames,
    are_static,
    fit_pair,
    fit_pairs,
    frame_costs,
)
from models.numerics.sampling import evenly_spread

Float64 = NDArray[np.float64]

SAMPLE = 400  # frames on which the move is sought
STARTS = (0.2, 0.5, 0.8)  # shares of the frames before the move
ROUNDS = 3
LEAST_SIDE = 5  # frames of the sample on either side
WINDOW = 0.06  # of the frames, on either side, that must show the jump
LEAST_WINDOW = 4  # frames
LEAST_SHARE = 0.04  # of the frames must lie beyond the window
SURE = 11.0  # standard errors of the jump
LEAST_JUMP = 0.3  # log likelihood ratio of a frame and pair of views
LEFT = 0.35  # of the cost of the move may be left with the matrices fitted after it
AS_SURE = 0.6  # of the best view's jump: above it another view may have moved as well
PUSHED = 3.0  # times the usual motion of a view between frames: then it is seen to jump


class MovedCamera(NamedTuple):
    """A view that moved at a frame, or two views of which one did."""

    views: tuple[int, ...]
    first: int  # frame that it was moved at
    jump: float  # log likelihood ratio of a frame and pair of views
    sure: float  # standard errors
    gain: float  # log likelihood


def find_moved_camera(seen: SeenFrames, matrices: Matrices) -> MovedCamera | None:
    """Find the view that was moved and the first frame after the move; None if it is uncertain."""
    frames = len(seen.there)
    kept = evenly_spread(frames, SAMPLE)
    if len(kept) < 4 * LEAST_SIDE or not matrices:
        return None
    at = _likely_frame(seen.part(kept), matrices)
    return None if at is None else _judge(seen, matrices, int(kept[at]))


def _likely_frame(seen: SeenFrames, matrices: Matrices) -> int | None:
    """Return the frame from which on other matrices gain most for the pairs of some view."""
    usual = {pair: float(frame_costs(seen, found, *pair).sum()) for pair, found in matrices.items()}
    best, most = None, 0.0
    for start in (*STARTS, *[None] * ROUNDS):
        split = best if start is None else int(start * len(seen.there))
        if split is None:
            return None
        sides = {pair: _split_costs(seen, pair, split, matrices) for pair in matrices}
        before = best
        for view in _paired(matrices):
            mine = [pair for pair in matrices if view in pair]
            at, cost = _best_split(np.sum([sides[pair] for pair in mine], 0))
            gain = sum(usual[pair] for pair in mine) - cost
            if gain > most:
                best, most = at, gain
        if start is None and best == before:
            break
    return best


def _split_costs(seen: SeenFrames, pair: tuple[int, int], at: int, matrices: Matrices) -> Float64:
    """Costs (2, N) of all frames under matrices fitted before and after a frame."""
    at = int(np.clip(at, LEAST_SIDE, len(seen.there) - LEAST_SIDE))
    return _costs_of_sides(seen, pair, (slice(None, at), slice(at, None)), matrices[pair])


def _costs_of_sides(
    seen: SeenFrames, pair: tuple[int, int], sides: tuple[slice, slice], usual: Fundamental
) -> Float64:
    """Costs (2, N) of all frames under matrices fitted to some frames and to others."""
    fitted = (fit_pair(seen.part(side), *pair) or usual for side in sides)
    return np.stack([frame_costs(seen, found, *pair) for found in fitted])


def _best_split(costs: Float64) -> tuple[int, float]:
    """Return the first frame for the second matrix, and what all frames cost then."""
    before = np.concatenate(([0.0], np.cumsum(costs[0])))
    after = np.concatenate(([0.0], np.cumsum(costs[1])))
    totals = before + after[-1] - after  # (N + 1,) of the first n frames with the first matrix
    at = int(totals[LEAST_SIDE:-LEAST_SIDE].argmin()) + LEAST_SIDE
    return at, float(totals[at])


def _judge(seen: SeenFrames, matrices: Matrices, first: int) -> MovedCamera | None:
    """Test for the jump in frames near the move, to which no matrix was fitted."""
    frames = len(seen.there)
    width = max(LEAST_WINDOW, int(WINDOW * frames))
    least = max(2 * LEAST_SIDE, int(LEAST_SHARE * frames))
    for _ in range(2):  # the second time around the frame that the first one found
        early, late = first - width, first + width
        if min(early, frames - late) < least:
            return None
        sides = (slice(None, early), slice(late, None))
        shown = {pair: usual for pair, usual in matrices.items() if _show(seen, pair, sides, least)}
        if not shown:
            return None
        costs = {pair: _costs_of_sides(seen, pair, sides, usual) for pair, usual in shown.items()}
        window = slice(early, late)
        jumps = {pair: _jump(both[:, window], first - early) for pair, both in costs.items()}
        alike = _most_likely(jumps)
        mine = [pair for pair in shown if alike[0] in pair]
        mean = np.mean([costs[pair] for pair in mine], 0)
        near = slice(max(first - 2 * width, 0), first + 2 * width)
        first = near.start + _best_split(mean[:, near])[0]
    if len(alike) > 1 and len(_paired(shown)) > 2:
        return None
    early, late = max(first - width, 0), first + width
    ratios = DEPENDENCE * (mean[0] - mean[1])
    before, after = ratios[early:first], ratios[first:late]
    jump = float(after.mean() - before.mean())
    error = max(float(np.hypot(_error(before), _error(after))), TINY)
    unmoved = float(np.median(mean[0, early:first]))
    excess, left = (float(np.median(side[first:late])) - unmoved for side in mean)
    abrupt = jump > max(LEAST_JUMP, SURE * error) and before.mean() < 0 < after.mean()
    if not abrupt or left > LEFT * excess:
        return None
    parts = (seen.part(slice(None, early)), seen.part(slice(late, None)))
    if not all(are_static(part, fit_pairs(part, tuple(mine))) for part in parts):
        return None
    plain = sum(float(frame_costs(seen, matrices[pair], *pair).sum()) for pair in mine)
    gain = plain - len(mine) * float(mean[0, :first].sum() + mean[1, first:].sum())
    views = (alike[0],) if len(alike) == 1 else _who_jumped(seen, alike, first)
    return MovedCamera(views, first, jump, jump / error, gain)


def _show(seen: SeenFrames, pair: tuple[int, int], sides: tuple[slice, slice], least: int) -> bool:
    """Whether both views of a pair show enough frames on either side, and neither has ended."""
    both = seen.there[:, pair[0]] & seen.there[:, pair[1]]
    shown: NDArray[np.bool_] = np.any(both, axis=-1)
    return all(shown[side].sum() >= least for side in sides)


def _jump(costs: Float64, at: int) -> float:
    ratios = DEPENDENCE * (costs[0] - costs[1])
    return float(ratios[at:].mean() - ratios[:at].mean())


def _most_likely(jumps: dict[tuple[int, int], float]) -> list[int]:
    """Return the view whose pairs jump most, and those that may have been moved as well.

    The jump of a pair may come from either of its views, so two views are compared by their pairs
    with all other views.
    """

    def mean_jump(view: int, but: int | None = None) -> float:
        own = [jump for pair, jump in jumps.items() if view in pair and but not in pair]
        return float(np.mean(own)) if own else 0.0

    views = _paired(jumps)
    best = max(views, key=mean_jump)
    rivals = [
        view
        for view in views
        if view != best and mean_jump(view, best) >= AS_SURE * mean_jump(best, view)
    ]
    return [best, *rivals]


def _paired(pairs: Iterable[tuple[int, int]]) -> list[int]:
    return sorted({view for pair in pairs for view in pair})


def _error(values: Float64) -> float:
    """Return the standard error of the mean of a series whose neighbours are correlated."""
    offsets = values - values.mean()
    variance = float(np.square(offsets).mean())
    if len(values) < 3 or variance == 0:
        return 0.0
    alike = float(np.clip((offsets[1:] * offsets[:-1]).mean() / variance, 0, 0.95))
    return float(np.sqrt(variance / len(values) * (1 + alike) / (1 - alike)))


def _who_jumped(seen: SeenFrames, views: list[int], first: int) -> tuple[int, ...]:
    """Of views that may all have moved, return those whose keypoints jump at that frame."""
    if len(views) == 1:
        return tuple(views)
    near = seen.part(slice(max(first - 6, 0), first + 6))
    both = near.there[1:] & near.there[:-1]
    steps: Float64 = np.where(both[..., None], np.diff(near.pixels, axis=0), np.nan)
    at = min(first, 6) - 1
    pushes = {}
    for view in views:
        shown: NDArray[np.bool_] = np.asarray(both[:, view].any(1))  # (T,)
        medians = np.nanmedian(steps[shown, view], 1)  # (T', 2) of all keypoints together
        moves = np.linalg.norm(medians, axis=-1)
        if shown[at] and len(moves) > 3:
            number = int(shown[:at].sum())
            usual = float(np.median(np.delete(moves, number)))
            pushes[view] = float(moves[number]) / max(usual, 1e-3)
    jumped = [view for view, push in pushes.items() if push > PUSHED]
    return tuple(jumped) if len(jumped) == 1 else tuple(views)
