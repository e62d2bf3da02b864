"""A camera at rest that was moved at some frame: one geometry before it, another from there on.

Two matrices for a pair of views always explain more than one, if only because the subject is
elsewhere later. What tells a camera that was moved is a jump: with matrices that were fitted to
frames well before and well after, the frames just before the move suit the first ones and the
frames just after it the others, although the subject is still at the same place.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.view_pairs import (
    DEPENDENCE,
    TINY,
    Matrices,
    Seen,
    at_rest,
    fit_pair,
    fit_pairs,
    frame_costs,
)

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
LEFT = 0.35  # of what the move costs may be left with the matrices that were fitted after it
AS_SURE = 0.6  # of the best view's gain: another view may as well have moved
PUSHED = 3.0  # times the usual motion of a view between frames: then it is seen to jump


class MovedCamera(NamedTuple):
    """A view that moved at a frame, or two views of which one did."""

    views: tuple[int, ...]
    first: int  # frame that it was moved at
    jump: float  # log likelihood ratio of a frame and pair of views
    sure: float  # standard errors
    gain: float  # log likelihood


def find_moved_camera(seen: Seen, matrices: Matrices) -> MovedCamera | None:
    """Find the view that was moved, and the first frame after that; None if none surely was."""
    frames, views = seen.there.shape[:2]
    kept = np.unique(np.linspace(0, frames - 1, min(frames, SAMPLE)).astype(np.intp))
    sample = seen.part(kept)
    if len(kept) < 4 * LEAST_SIDE:
        return None
    usual = {pair: frame_costs(sample, found, *pair).sum() for pair, found in matrices.items()}
    tried: dict[int, tuple[float, int]] = {}
    for start in STARTS:
        split = int(start * len(kept))
        halves = {pair: _split_costs(sample, pair, split, matrices) for pair in matrices}
        for view in range(views):
            mine = [pair for pair in matrices if view in pair]
            if mine:
                cost, at = _best_split(np.sum([halves[pair] for pair in mine], 0))
                gain = float(sum(usual[pair] for pair in mine)) - cost
                tried[view] = max(tried.get(view, (0.0, at)), (gain, at))
    if not tried:
        return None
    view = max(tried, key=tried.__getitem__)
    gain, at = tried[view]
    mine = [pair for pair in matrices if view in pair]
    for _ in range(ROUNDS):
        before = at
        _, at = _best_split(np.sum([_split_costs(sample, p, at, matrices) for p in mine], 0))
        if at == before:
            break
    alike = [other for other in tried if tried[other][0] > AS_SURE * gain]
    if gain <= 0 or (len(alike) > 1 and views > 2):
        return None
    found = _judge(seen, mine, matrices, view, int(kept[at]))
    if found is None or len(alike) == 1:
        return found
    return found._replace(views=_who_jumped(seen, alike, found.first))


def _split_costs(seen: Seen, pair: tuple[int, int], at: int, matrices: Matrices) -> Float64:
    """Costs (2, N) of all frames under matrices fitted before and after a frame."""
    at = int(np.clip(at, LEAST_SIDE, len(seen.there) - LEAST_SIDE))
    sides = (seen.part(slice(None, at)), seen.part(slice(at, None)))
    fitted = (fit_pair(side, *pair) or matrices[pair] for side in sides)
    return np.stack([frame_costs(seen, found, *pair) for found in fitted])


def _best_split(costs: Float64) -> tuple[float, int]:
    """Return what frames cost, and the first one for which the second matrix is to be used."""
    before = np.concatenate(([0.0], np.cumsum(costs[0])))
    after = np.concatenate(([0.0], np.cumsum(costs[1])))
    totals = before + after[-1] - after  # (N + 1,) of the first n frames with the first matrix
    at = int(totals[LEAST_SIDE:-LEAST_SIDE].argmin()) + LEAST_SIDE
    return float(totals[at]), at


def _judge(
    seen: Seen, mine: list[tuple[int, int]], matrices: Matrices, view: int, first: int
) -> MovedCamera | None:
    """Look for the jump in frames near the move that no matrix was fitted to."""
    frames = len(seen.there)
    width = max(LEAST_WINDOW, int(WINDOW * frames))
    least = max(2 * LEAST_SIDE, int(LEAST_SHARE * frames))
    for _ in range(2):  # once more about the very frame
        early, late = first - width, first + width
        if min(early, frames - late) < least:
            return None
        costs = np.zeros((2, frames))
        for pair in mine:
            for number, side in enumerate((slice(None, early), slice(late, None))):
                found = fit_pair(seen.part(side), *pair) or matrices[pair]
                costs[number] += frame_costs(seen, found, *pair) / len(mine)
        near = slice(max(first - 2 * width, 0), first + 2 * width)
        first = near.start + _best_split(costs[:, near])[1]
    early, late = max(first - width, 0), first + width
    ratios = DEPENDENCE * (costs[0] - costs[1])
    before, after = ratios[early:first], ratios[first:late]
    jump = float(after.mean() - before.mean())
    error = max(float(np.hypot(_error(before), _error(after))), TINY)
    usual = float(np.median(costs[0, early:first]))
    excess, left = (float(np.median(side[first:late])) - usual for side in costs)
    abrupt = jump > max(LEAST_JUMP, SURE * error) and before.mean() < 0 < after.mean()
    if not abrupt or left > LEFT * excess:
        return None
    parts = (seen.part(slice(None, early)), seen.part(slice(late, None)))
    if not all(at_rest(part, fit_pairs(part, tuple(mine))) for part in parts):
        return None
    plain = sum(float(frame_costs(seen, matrices[pair], *pair).sum()) for pair in mine)
    gain = plain - len(mine) * float(costs[0, :first].sum() + costs[1, first:].sum())
    return MovedCamera((view,), first, jump, jump / error, gain)


def _error(values: Float64) -> float:
    """Return the standard error of the mean of a series whose neighbours are alike."""
    offsets = values - values.mean()
    variance = float(np.square(offsets).mean())
    if len(values) < 3 or variance == 0:
        return 0.0
    alike = float(np.clip((offsets[1:] * offsets[:-1]).mean() / variance, 0, 0.95))
    return float(np.sqrt(variance / len(values) * (1 + alike) / (1 - alike)))


def _who_jumped(seen: Seen, views: list[int], first: int) -> tuple[int, ...]:
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
