"""Frames in which views were exchanged, found from pairs of static views.

A frame with two views exchanged fits the fundamental matrices of the other frames once they are put
back. The exchanged frames and the matrices are estimated in turn, from several starts: if half of
the frames are exchanged, no single fit to all of them is right.
"""

from itertools import combinations
from operator import attrgetter, itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.runs_of_frames import likely_frames
from models.epipolar.view_pairs import (
    DEPENDENCE,
    Matrices,
    Pairs,
    SeenFrames,
    are_static,
    between,
    fit_pairs,
    frame_costs,
    total_cost,
)
from models.numerics.sampling import evenly_spread

Float64 = NDArray[np.float64]
Order = NDArray[np.intp]

SAMPLE = 240  # frames on which the order of views is sought
SAMPLED_KEYPOINTS = 16
START_FRAMES, STARTS = 3, 12  # frames of a start: few, so that one start has none exchanged
START_RUNS = 5  # starts of neighbouring frames
START_SAMPLE = 80  # frames by which starts are compared
BEST_STARTS = 3  # that are followed to their end
ROUNDS = 4
MOST_EXCHANGES = 3  # in one frame: any order of four views
LEAST_FRAMES = 2
LEAST_SHARE = 0.01  # of frames
LEAST_RATIO = 15.0  # log likelihood ratio of all exchanged frames together
LEAST_FRAME_RATIO = 2.0  # of an exchanged frame, in the median
ALIKE = 0.2  # of the gain: exchanged frames, put back, may cost that much more than other frames
CLEAR = 0.9  # of the frames: if so many have a certain order of views, no other start is tried
FEW_EXCHANGED = 0.75  # of the frames: if so many have the same order, no other start either
SETTLED = 1e-3  # of the cost


class SwappedViews(NamedTuple):
    """Frames (N,) in which two or more views have changed places with each other."""

    views: tuple[int, ...]
    frames: NDArray[np.bool_]
    order: tuple[int, ...]  # of all views: where the keypoints of each are found in these frames
    ratio: float  # log likelihood ratio


class Reordered(NamedTuple):
    """The exchanges found, the frames with their views put back, and the gain in log likelihood."""

    found: tuple[SwappedViews, ...]
    seen: SeenFrames
    matrices: Matrices
    gain: float


def find_swapped_views(seen: SeenFrames, pairs: Pairs, plain: Matrices) -> Reordered | None:
    """Find which views were exchanged and in which frames; None if it is uncertain.

    `plain` are the matrices of the frames as they are.
    """
    sample = seen.part(evenly_spread(len(seen.there), SAMPLE)).thinned(SAMPLED_KEYPOINTS)
    matrices = _search(sample, pairs, np.random.default_rng(0))
    order = _reorder(sample, matrices)
    if not are_static(sample.reordered(order), matrices):
        return None
    kinds, found, order = _kinds(order), [], _straight(seen)
    for kind in kinds:
        swapped = _judge(seen, matrices, kind)
        if swapped is not None:
            found.append(swapped)
            order[swapped.frames] = kind
    if not found:
        return None
    back = seen.reordered(order)
    gain = total_cost(seen, plain) - total_cost(back, matrices)
    return Reordered(tuple(found), back, matrices, gain)


def _search(sample: SeenFrames, pairs: Pairs, rng: np.random.Generator) -> Matrices:
    """Return the matrices under which the sample, with views put back, is most likely."""
    frames = len(sample.there)
    first = _settle(sample, pairs, fit_pairs(sample, pairs))
    length = max(START_FRAMES, frames // 16)
    if frames < 2 * length or _clear(sample, first[1]):
        return _majority(sample, first[1])
    few = sample.part(evenly_spread(frames, START_SAMPLE))
    begins = np.linspace(0, frames - length, START_RUNS).astype(int)
    starts = [np.arange(begin, begin + length) for begin in begins]
    starts += [rng.choice(frames, START_FRAMES, replace=False) for _ in range(STARTS)]
    tried = []
    for start in starts:
        matrices = fit_pairs(sample.part(start), pairs)
        if len(matrices) == len(pairs):
            tried.append(_turn(few, pairs, matrices))
    best = sorted(tried, key=itemgetter(0))[:BEST_STARTS]
    if not any(are_static(_put_back(few, matrices), matrices) for _, matrices in best):
        return first[1]
    ended = [first] + [_settle(sample, pairs, matrices) for _, matrices in best]
    matrices = _majority(sample, min(ended, key=itemgetter(0))[1])
    anew = fit_pairs(_put_back(sample, matrices), pairs)
    return {
        pair: min(matrices.get(pair, found), found, key=attrgetter("scale"))
        for pair, found in anew.items()
    }


def _settle(sample: SeenFrames, pairs: Pairs, matrices: Matrices) -> tuple[float, Matrices]:
    """Put views back and fit in turns until neither changes much."""
    cost, matrices = _turn(sample, pairs, matrices)
    for _ in range(ROUNDS - 1):
        before = cost
        cost, matrices = _turn(sample, pairs, matrices)
        if cost > before - SETTLED * abs(before):
            break
    return cost, matrices


def _clear(sample: SeenFrames, matrices: Matrices) -> bool:
    """Whether nearly every frame certainly has its views in the order of most frames."""
    order = _reorder(sample, matrices)
    margins = -DEPENDENCE * _gains(sample.reordered(order), matrices).max(1)
    usual = np.unique(order, axis=0, return_counts=True)[1].max() / len(order)
    return bool((margins > LEAST_FRAME_RATIO).mean() > CLEAR and usual > FEW_EXCHANGED)


def _turn(sample: SeenFrames, pairs: Pairs, matrices: Matrices) -> tuple[float, Matrices]:
    """Put views back, and fit the matrices anew; return also the cost."""
    back = _put_back(sample, matrices)
    fitted = fit_pairs(back, pairs, matrices)
    return total_cost(back, fitted), fitted


def _put_back(sample: SeenFrames, matrices: Matrices) -> SeenFrames:
    """Return the frames with their views in the most likely order."""
    return sample.reordered(_reorder(sample, matrices))


def _straight(seen: SeenFrames) -> Order:
    """Return the order of views (N, K) as they are."""
    frames, views = seen.there.shape[:2]
    return np.tile(np.arange(views), (frames, 1))


def _reorder(seen: SeenFrames, matrices: Matrices) -> Order:
    """Return the order of views (N, K) of every frame that exchanges of two views lead to."""
    order = _straight(seen)
    frames, views = order.shape
    left = np.arange(frames)
    for _ in range(MOST_EXCHANGES):
        here = seen.part(left).reordered(order[left])
        gains = _gains(here, matrices)  # (N', exchanges)
        best = gains.argmax(1)
        better = gains[np.arange(len(left)), best] > 0
        left, best = left[better], best[better]
        if not len(left):
            break
        exchanges = np.array(list(combinations(range(views), 2)))[best]  # (N', 2)
        rows = left[:, None]
        order[rows, exchanges] = order[rows, exchanges[:, ::-1]]
    return order


def _gains(seen: SeenFrames, matrices: Matrices) -> Float64:
    """Log likelihood ratio (N, K (K - 1) / 2) of each exchange of two views to none."""
    frames, views = seen.there.shape[:2]
    as_is = {pair: frame_costs(seen, found, *pair) for pair, found in matrices.items()}
    gains = []
    for i, j in combinations(range(views), 2):
        exchanged = {i: j, j: i}
        gain = np.zeros(frames)
        for (a, b), costs in as_is.items():
            c, d = exchanged.get(a, a), exchanged.get(b, b)
            found = between(matrices, c, d)
            if (c, d) != (a, b) and found is not None:
                gain += costs - frame_costs(seen, found, a, b)
        gains.append(gain)
    return np.stack(gains, 1)


def _majority(sample: SeenFrames, matrices: Matrices) -> Matrices:
    """Make the order of views that most frames have the reference."""
    kinds, counts = np.unique(_reorder(sample, matrices), axis=0, return_counts=True)
    usual = kinds[counts.argmax()].tolist()
    renamed = {
        (min(usual[a], usual[b]), max(usual[a], usual[b])): between(
            matrices, *((a, b) if usual[a] < usual[b] else (b, a))
        )
        for a, b in matrices
    }
    return {pair: found for pair, found in renamed.items() if found is not None}


def _kinds(order: Order) -> list[Order]:
    """Return the orders of views that are not straight and not rare, the most frequent first."""
    kinds, counts = np.unique(order, axis=0, return_counts=True)
    enough = counts >= max(LEAST_FRAMES, LEAST_SHARE * len(order))
    straight = (kinds == np.arange(order.shape[1])).all(1)
    chosen = np.flatnonzero(enough & ~straight)
    return [kinds[k] for k in chosen[np.argsort(-counts[chosen], kind="stable")]]


def _judge(seen: SeenFrames, matrices: Matrices, kind: Order) -> SwappedViews | None:
    """Return the frames with their views in the order `kind`, if that is certain enough."""
    frames = len(seen.there)
    touched = [pair for pair in matrices if kind[pair[0]] != pair[0] or kind[pair[1]] != pair[1]]
    back = seen.reordered(np.tile(kind, (frames, 1)))
    ratios, after, usual = np.zeros(frames), np.zeros(frames), np.zeros(frames)
    for a, b in touched:
        as_is, put_back = (frame_costs(one, matrices[a, b], a, b) for one in (seen, back))
        ratios += DEPENDENCE * (as_is - put_back)
        counted = [(one.there[:, a] & one.there[:, b]).sum(1).clip(1) for one in (seen, back)]
        usual += as_is / counted[0]
        after += put_back / counted[1]
    named = likely_frames(ratios) & (ratios > -LEAST_FRAME_RATIO)
    if named.sum() < max(LEAST_FRAMES, LEAST_SHARE * frames) or named.all():
        return None
    sure = ratios[named].sum() > LEAST_RATIO and np.median(ratios[named]) > LEAST_FRAME_RATIO
    normal = float(np.median(usual[~named]))
    gained = float(np.median(usual[named])) - normal
    alike = float(np.median(after[named])) - normal < ALIKE * gained
    apart = np.median(ratios[~named]) < -LEAST_FRAME_RATIO
    if not (sure and alike and apart):
        return None
    views = tuple(int(view) for view in np.flatnonzero(kind != np.arange(len(kind))))
    return SwappedViews(views, named, tuple(kind.tolist()), float(ratios[named].sum()))
