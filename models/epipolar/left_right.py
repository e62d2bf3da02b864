"""Views in which left and right keypoints are exchanged, compared with the other views.

Pairs of left and right keypoints are not given. They are found as those whose exchange in one view
brings them onto the epipolar lines of the other views. A view may have them exchanged in all frames
(a mirrored image, another order of keypoints) or in some.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.runs_of_frames import likely_frames
from models.epipolar.symmetry import Partners, matched, unlikeness
from models.epipolar.view_pairs import (
    DEPENDENCE,
    Matrices,
    SeenFrames,
    are_static,
    between,
    fit_pair,
    frame_costs,
    point_costs,
)
from models.numerics.sampling import evenly_spread

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

SAMPLE = 160  # frames on which exchanges are sought
TABLE, LEAST_TABLE = 300_000, 24  # costs, and frames, by which keypoints are matched
ROUNDS = 6
DOUBTED = (1.0, 0.25, 0.06)  # shares of the frames, those that fit worst, that may be exchanged
BENEFIT_SURE = 3.0  # standard errors of what it gains to exchange two keypoints
LEAST_PAIRS = 2  # of keypoints; a pair alone is a detector's confusion
LEAST_FRAMES, LEAST_SHARE = 2, 0.02
LEAST_RATIO = 30.0  # log likelihood ratio of all frames together
CLEAR_FRAME = 0.7  # log likelihood ratio of an exchanged frame, in the median
AS_GOOD = 0.7  # of the best view's gain: another view explains as much, and both are named
ALL = 0.98  # of the frames


class LeftRightSwapped(NamedTuple):
    """Views of which one shows keypoints exchanged in some frames (N,)."""

    views: tuple[int, ...]
    frames: Bool
    partners: Partners
    seen: SeenFrames  # with the keypoints put back
    gain: float  # log likelihood


def find_left_right(seen: SeenFrames, matrices: Matrices) -> LeftRightSwapped | None:
    """Find the view in which left and right are exchanged compared with the others, if any."""
    frames, views = seen.there.shape[:2]
    kept = evenly_spread(frames, min(frames // 2, SAMPLE))
    sample, unseen = seen.part(kept), np.ones(frames, np.bool_)
    unseen[kept] = False
    alike = unlikeness(sample)
    tried = {}
    for view in range(views):
        mine = {pair: found for pair, found in matrices.items() if view in pair}
        trial = _best(sample, view, mine, alike) if mine else None
        if trial is not None:
            tried[view] = trial
    if not tried:
        return None
    best = max(tried, key=lambda view: tried[view].gain)
    found = tried[best]
    as_good = [view for view, trial in tried.items() if trial.gain > AS_GOOD * found.gain]
    if len(as_good) > 1 and views > 2:
        return None
    before = {pair: matrices[pair] for pair in found.matrices}
    return _judge(seen, best, found, before, unseen, as_good, np.isfinite(alike))


def exchanged(seen: SeenFrames, view: int, partners: Partners, frames: Bool) -> SeenFrames:
    """Return the frames with keypoints of a view exchanged in some of them (N,)."""
    pixels, there = seen.pixels.copy(), seen.there.copy()
    pixels[frames, view] = pixels[frames, view][:, partners]
    there[frames, view] = there[frames, view][:, partners]
    return seen._replace(pixels=pixels, there=there)


class _Trial(NamedTuple):
    """An exchange of a view's keypoints in some frames, and its gain on the sample."""

    partners: Partners
    matrices: Matrices
    gain: float


def _best(sample: SeenFrames, view: int, matrices: Matrices, alike: Float64) -> _Trial | None:
    """Return the exchange in a view that gains most, from several starts."""
    before = _costs(sample, matrices)
    trials = []
    for start in _starts(sample, view, matrices, alike):
        costs = _costs(sample, start)
        other = exchanged(sample, view, matched(alike), np.ones(len(costs), np.bool_))
        likely = likely_frames(DEPENDENCE * (costs - _costs(other, start)))
        worst = (costs >= np.quantile(costs, 1 - share) for share in DOUBTED)
        for doubted in (*worst, likely):
            trial = _improve(sample, view, start, doubted, np.isfinite(alike))
            if trial is not None:
                trials.append(trial._replace(gain=before.sum() + trial.gain))
    return max(trials, key=lambda trial: trial.gain, default=None)


def _starts(
    sample: SeenFrames, view: int, matrices: Matrices, alike: Float64
) -> Iterator[Matrices]:
    """Yield matrices of a view: as they are, and with similar keypoints exchanged in all frames."""
    yield matrices
    every = np.ones(len(sample.there), np.bool_)
    other = exchanged(sample, view, matched(alike), every)
    yield {pair: fit_pair(other, *pair) or found for pair, found in matrices.items()}


def _improve(
    sample: SeenFrames, view: int, matrices: Matrices, doubted: Bool, allowed: Bool
) -> _Trial | None:
    """Find partners, frames and matrices in turns; the gain is the cost in the end, below 0."""
    trial, before = None, None
    for _ in range(ROUNDS):
        if doubted.sum() < LEAST_FRAMES:
            return trial
        partners = _partners(sample.part(doubted), view, matrices, allowed)
        if partners is None or (before is not None and (partners == before).all()):
            return trial
        before = partners
        other = exchanged(sample, view, partners, np.ones(len(doubted), np.bool_))
        doubted = _costs(sample, matrices) > _costs(other, matrices)
        mended = exchanged(sample, view, partners, doubted)
        matrices = {
            pair: fit_pair(mended, *pair, found) or found for pair, found in matrices.items()
        }
        cost = float(_costs(mended, matrices).sum())
        trial = _Trial(partners, matrices, -cost)
    return trial


def _costs(seen: SeenFrames, matrices: Matrices) -> Float64:
    """Cost (N,) of all pairs of a view together."""
    costs: Float64 = sum(
        (frame_costs(seen, found, *pair) for pair, found in matrices.items()),
        start=np.zeros(len(seen.there)),
    )
    return costs


def _partners(seen: SeenFrames, view: int, matrices: Matrices, allowed: Bool) -> Partners | None:
    """Choose which keypoints of a view to exchange, among the allowed pairs (P, P)."""
    p, q = np.nonzero(np.triu(allowed))
    most = max(LEAST_TABLE, TABLE // (max(len(p), 1) * len(matrices)))
    few = seen.part(evenly_spread(len(seen.there), most))
    gains = np.zeros((len(few.there), len(p)))
    for a, b in matrices:
        other = b if view == a else a
        found = between(matrices, view, other)
        if found is None:
            continue
        for sign, mine, theirs in ((1, p, p), (1, q, q), (-1, p, q), (-1, q, p)):
            both = few.there[:, view, mine] & few.there[:, other, theirs]
            x, y = few.pixels[:, view, mine], few.pixels[:, other, theirs]
            gains += sign * point_costs(found, x, y, both, few.radius)
    benefits = gains.mean(0)
    sure = benefits > BENEFIT_SURE * gains.std(0) / np.sqrt(len(gains))
    costs = np.full(allowed.shape, np.inf)
    costs[p[sure], q[sure]] = -benefits[sure]
    partners = matched(costs)
    moved = int((partners != np.arange(len(partners))).sum())
    return partners if moved >= 2 * LEAST_PAIRS else None


def _judge(
    seen: SeenFrames,
    view: int,
    found: _Trial,
    before: Matrices,
    unseen: Bool,
    as_good: list[int],
    allowed: Bool,
) -> LeftRightSwapped | None:
    """Return the frames with exchanged keypoints, if frames outside the sample confirm it."""
    every = np.ones(len(seen.there), np.bool_)
    costs = _costs(seen, found.matrices)
    for _ in range(2):
        after = _costs(exchanged(seen, view, found.partners, every), found.matrices)
        ratios = DEPENDENCE * (costs - after)
        named = likely_frames(ratios)
        if named.any():
            again = _partners(seen.part(named), view, found.matrices, allowed)
            found = found._replace(partners=found.partners if again is None else again)
    if named.mean() > ALL:
        named = every
        # In all frames even keypoints that do not look alike, as of arms that swing, show it.
        again = _partners(seen, view, found.matrices, np.ones_like(allowed))
        found = found._replace(partners=found.partners if again is None else again)
    if named.sum() < max(LEAST_FRAMES, LEAST_SHARE * len(named)):
        return None
    mended = exchanged(seen, view, found.partners, named)
    gains = _costs(seen, before) - _costs(mended, found.matrices)
    clear = np.median(ratios[named]) > CLEAR_FRAME
    if DEPENDENCE * gains[unseen].sum() < LEAST_RATIO or not clear:
        return None
    if not are_static(mended, found.matrices):
        return None
    return LeftRightSwapped(tuple(as_good), named, found.partners, mended, float(gains.sum()))
