"""Offsets of whole frames over all that two views share: every offset at once, by correlation.

*Geometry*: the sums that determine a fundamental matrix are sums over frames of a monomial of one
view's keypoints times one of the other's. So their cross-correlations give these sums for all
offsets at once, and each offset its mean square distance from epipolar lines. That is for static
cameras.

*Motion*: how fast a keypoint moves, relative to the subject's middle and size, depends little on
where a camera stands or how it moves. The normalised cross-correlation of these speeds is highest
where both views show the same moment.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.tracks import Motion
from models.epipolar.taubin import gradients_of, reduced
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Int = NDArray[np.int64]
Pair = tuple[int, int]

LEAST_SHARED, LEAST_SHARE = 30, 0.2  # frames, and share of all frames, that two views share
MOST_LAGS = 30_000  # of all pairs together
BEYOND = 4.0  # times the extent of all keypoints: farther ones are drawn in
FLOOR = 2e-4  # of the extent: finer than any detector or lens model
SLOWEST = 1e-3  # of the subject's size in a frame: slower is still
MOST_LIKE = 0.99  # correlation: speeds are never more alike
APART = 4  # frames: nearer offsets are the same candidate
CLEAR = 0.35  # nats: geometry of static cameras leaves no doubt
PRODUCTS = np.array([[3, 4, 1], [4, 5, 2], [1, 2, 0]])  # monomials of (x, y, 1) (x, y, 1)^T


class Signals(NamedTuple):
    """What is correlated of a view, over N frames of P keypoints; 0 where not observed."""

    monomials: Float64  # (6, P, N) 1, x, y, xx, xy, yy
    speeds: Float64  # (3, P, N) logarithms of speeds, of mean 0; their squares; 1 where known

    def within(self, frames: NDArray[np.bool_]) -> "Signals":
        """Return the signals of some frames (N,), 0 in the others."""
        return Signals(self.monomials * frames, self.speeds * frames)


class Profile(NamedTuple):
    """Costs of a pair of views at all lags from -M to M; the less, the better they match."""

    geometry: Float64  # (2 M + 1,) logarithm of the distance from epipolar lines
    motion: Float64  # (2 M + 1,) logarithm of the share of speeds that are unlike


def signals_of(motion: Motion) -> Signals:
    """Return the signals of a view's keypoints and their velocities (N, P, 2)."""
    there = np.asarray(np.isfinite(motion.places).all(-1))
    places = np.where(there[..., None], motion.places, 0.0)
    extent = np.sqrt(np.square(places).sum() / max(2 * int(there.sum()), 1)) + TINY
    x, y = (places / extent).clip(-BEYOND, BEYOND).transpose(2, 1, 0)
    known = there & np.isfinite(motion.velocities).all(-1)
    velocities = np.where(known[..., None], motion.velocities, 0.0)
    count = np.maximum(known.sum(1), 1)[:, None, None]
    mask = known[..., None]
    away = velocities - velocities.sum(1, keepdims=True) / count
    around = np.where(mask, places - (places * mask).sum(1, keepdims=True) / count, 0.0)
    size = np.sqrt(np.square(around).sum((1, 2)) / count[:, 0, 0])[:, None] + TINY
    logs = np.log(np.linalg.norm(away, axis=-1) / size + SLOWEST)
    frames = np.maximum(known.sum(0), 1)
    logs = np.where(known, logs - (logs * known).sum(0) / frames, 0.0)
    logs = (logs / (np.sqrt(np.square(logs).sum(0) / frames) + TINY)).T
    seen = there.T.astype(np.float64)
    return Signals(np.stack((seen, x, y, x * x, x * y, y * y)), np.stack((logs, logs**2, known.T)))


def longest_lag(frames: int, pairs: int) -> int:
    """Return by how many frames two views may differ at most: enough frames are then shared."""
    shared = max(LEAST_SHARED, int(LEAST_SHARE * frames))
    return max(0, min(frames - shared, MOST_LAGS // (2 * pairs)))


def profiles_of(signals: list[Signals], pairs: list[Pair], most: int) -> dict[Pair, Profile]:
    """Return the costs of the pairs at lags of up to `most` frames either way.

    A lag is how many frames later the second view is read. Where too little is shared, costs are
    the highest of the pair. A pair that never shares enough is left out.
    """
    frames = signals[0].monomials.shape[-1]
    size = 1 << (frames + most - 1).bit_length()
    spectra = [
        tuple(np.fft.rfft(part, size).transpose(2, 0, 1) for part in of_view) for of_view in signals
    ]
    found = {}
    for first, second in pairs:
        by_place, by_speed = (
            _correlated(a, b, most) for a, b in zip(spectra[first], spectra[second], strict=True)
        )
        shared = by_place[:, 0, 0]
        usual = np.minimum(*(signals[view].monomials[0].sum() for view in (first, second))) / frames
        enough = shared > usual * max(LEAST_SHARED, LEAST_SHARE * frames) * 0.7
        if enough.any():
            profile = _geometry(by_place[enough]), _motion(by_speed[enough])
            costs = np.stack([np.repeat(cost.max(), len(enough)) for cost in profile])
            costs[:, enough] = profile
            found[first, second] = Profile(*costs)
    return found


def _correlated(
    first: NDArray[np.complex128], second: NDArray[np.complex128], most: int
) -> Float64:
    """Sum products of two spectra (F, A, P) and (F, B, P) over P, at all lags: (2 M + 1, B, A)."""
    sums = np.fft.irfft(second @ first.conj().mT, axis=0)
    return np.concatenate((sums[len(sums) - most :], sums[: most + 1]))


def _geometry(sums: Float64) -> Float64:
    means = sums / sums[:, :1, :1]
    normal = means[:, PRODUCTS[:, None, :, None], PRODUCTS[None, :, None, :]].reshape(-1, 9, 9)
    gradients = gradients_of(means[:, 0][:, PRODUCTS], means[:, :, 0][:, PRODUCTS])
    squares = np.linalg.eigvalsh(reduced(normal, gradients).matrix)[:, 0]
    return np.asarray(np.log(np.maximum(squares, 0) + FLOOR**2) / 2, np.float64)


def _motion(sums: Float64) -> Float64:
    norms = np.sqrt(np.maximum(sums[:, 2, 1] * sums[:, 1, 2], TINY))
    like = (sums[:, 0, 0] / norms).clip(0, MOST_LIKE)
    return np.asarray(np.log1p(-(like**2)) / 2, np.float64)


def offsets_together(costs: dict[Pair, Float64], views: int) -> Int:
    """Return the whole offsets (K,) of least cost over all pairs, relative to most of the views.

    By coordinate descent, from views in step and from what the pairs of each view like best.
    """
    most = len(next(iter(costs.values()))) // 2
    best, least = np.zeros(views, np.int64), np.inf
    for reference in range(-1, views):
        offsets = np.zeros(views, np.int64)
        for (first, second), cost in costs.items():
            if reference in (first, second):
                lag = int(np.argmin(cost)) - most
                offsets[second if reference == first else first] = (
                    lag if reference == first else -lag
                )
        before = np.inf
        while True:
            now = 0.0
            for view in range(views):
                along = costs_of_view(costs, view, offsets)
                offsets[view] = int(np.argmin(along)) - most
                now += float(along.min())
            if now >= before:
                break
            before = now
        if before < least:
            best, least = offsets.copy(), before
    return relative(best)


def relative(offsets: Int) -> Int:
    """Return offsets (K,) of which most are 0, of two views the first."""
    values, counts = np.unique(offsets, return_counts=True)
    common = values[counts == counts.max()]
    if len(offsets) == 2:
        return np.asarray(offsets - offsets[0], np.int64)
    usual = common[np.argmin(np.abs(common - np.median(offsets)))]
    return np.asarray(offsets - usual, np.int64)


def costs_of_view(costs: dict[Pair, Float64], view: int, offsets: Int) -> Float64:
    """Return the cost (2 M + 1,) of a view's pairs at each of its offsets; the others keep theirs.

    Beyond the lags of a pair, it costs what its worst lag does.
    """
    most = len(next(iter(costs.values()))) // 2
    tried = np.arange(-most, most + 1)
    total = np.zeros(len(tried))
    for (first, second), cost in costs.items():
        if view in (first, second):
            lag = tried - offsets[first] if view == second else offsets[second] - tried
            inside = np.abs(lag) <= most
            total += np.where(inside, cost[lag.clip(-most, most) + most], cost.max())
    return total if total.any() else np.abs(tried).astype(np.float64)


def standardised(cost: Float64) -> Float64:
    """Return how many of its usual deviations a cost (D,) lies from its median."""
    away = cost - np.median(cost)
    spread: Float64 = away / (np.median(np.abs(away)) + TINY)
    return spread


def lowest(along: Float64, count: int) -> list[int]:
    """Return the offsets of the `count` least costs (2 M + 1,) around which others cost more."""
    most, chosen = len(along) // 2, list[int]()
    padded = np.pad(along, APART, constant_values=np.inf)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * APART + 1).min(-1)
    places = np.flatnonzero((along == around) & (along < along.max()))
    for place in places[np.argsort(along[places], kind="stable")]:
        if len(chosen) < count and all(abs(place - most - other) > APART for other in chosen):
            chosen.append(int(place) - most)
    return chosen


class Coarse(NamedTuple):
    """Whole offsets that suit all pairs of views, and what each view might have instead."""

    offsets: Int  # (K,) frames, relative to most of the views
    geometry: dict[Pair, Float64]  # (2 M + 1,) costs by geometry
    motion: dict[Pair, Float64]  # (2 M + 1,) costs by motion

    def starts(self) -> list[Int]:
        """Return whole offsets (K,) to refine: by both, by geometry alone, and in step."""
        views = len(self.offsets)
        return [self.offsets, offsets_together(self.geometry, views), np.zeros(views, np.int64)]

    def clear(self, view: int, offsets: Int) -> bool:
        """Whether static cameras leave no doubt of a view's own of the `offsets` (K,)."""
        geometry, _ = self._costs(view, offsets)
        best = lowest(geometry, 2)
        if len(best) < 2 or abs(best[0] - int(offsets[view])) > 1:
            return False
        least, next_least = geometry[[offset + len(geometry) // 2 for offset in best]]
        return bool(next_least - least > CLEAR)

    def rivals(self, view: int, offsets: Int) -> list[int]:
        """Return other offsets that a view may have than its own of `offsets` (K,).

        None for a view in step if static cameras leave no doubt. Else the best by geometry and by
        motion: a movement that repeats leaves no doubt either, at any of its periods.
        """
        own = int(offsets[view])
        if own == 0 and self.clear(view, offsets):
            return []
        geometry, motion = self._costs(view, offsets)
        both = standardised(geometry) + standardised(motion)
        rivals: list[int] = []
        for offset in [*lowest(geometry, 2), *lowest(motion, 2), *lowest(both, 2)]:
            if all(abs(offset - other) > APART for other in (own, *rivals)):
                rivals.append(offset)
        return rivals

    def _costs(self, view: int, offsets: Int) -> tuple[Float64, Float64]:
        """Return the costs (2 M + 1,) of a view's offsets by geometry and by motion, of a pair."""
        pairs = max(sum(view in pair for pair in self.geometry), 1)
        by_geometry = costs_of_view(self.geometry, view, offsets) / pairs
        return by_geometry, costs_of_view(self.motion, view, offsets) / pairs


def search(motions: list[Motion], pairs: list[Pair], most: int | None = None) -> Coarse | None:
    """Search whole offsets of views with motions (N, P) over all frames that they share.

    Or over `most` frames to either side. None if no pair shares enough.
    """
    signals = [signals_of(motion) for motion in motions]
    longest = longest_lag(len(motions[0].places), len(pairs))
    most = longest if most is None else min(most, longest)
    profiles = profiles_of(signals, pairs, most)
    if not profiles:
        return None
    both = {
        pair: standardised(profile.geometry) + standardised(profile.motion)
        for pair, profile in profiles.items()
    }
    return Coarse(
        offsets_together(both, len(motions)),
        {pair: profile.geometry for pair, profile in profiles.items()},
        {pair: profile.motion for pair, profile in profiles.items()},
    )
