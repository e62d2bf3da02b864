"""Matching people between cameras by the epipolar geometry of a capture.

Static cameras have one fundamental matrix for all frames and all people. It is estimated from a
person in one camera and a person in another; if they are the same, the other people fit it, too. If
no such matrix fits, cameras move, and frames are matched one by one: from far away, the keypoints
of one body in two cameras have rank three (Tomasi and Kanade, 1992).
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from fewview.capture import located
from fewview.readers.views import Int64

FRAMES, POINTS = 80, 1500  # of two tracks that are compared, at most
FEWEST = 40  # points that two tracks share, to compare them
LONGEST = 24  # tracks of a camera that are compared
HYPOTHESES = 12  # pairs of tracks that a fundamental matrix is tried from
FAR = 0.1  # of a body's size: what is further off than this is just wrong
STATIC = 0.5  # share of all possible pairs that fit, if cameras are static
SURE = 0.2  # by how much the best matching is better than any other
ROUNDS = 8  # of reweighting
Float = NDArray[np.float64]
Pair = tuple[int, int]  # of tracks, or of cameras
Costs = dict[Pair, float]  # mean distance from what fits, in sizes of a body, FAR at most
Matching = dict[Pair, float]  # frames together, less what does not fit
Tried = tuple[Costs, Matching]


@dataclass(frozen=True)
class Track:
    """Somebody in one camera, as far as they could be followed.

    Attributes
    ----------
    view
        Index of the camera.
    rows, places
        (n,) frames of that camera, and the place in each one's list of people.
    numbers
        (n,) numbers of these frames, the same in all cameras.
    points
        (n, P, 2) pixels, NaN where not detected.
    amount
        How much is seen of them: the sum of confidences.
    """

    view: int
    rows: Int64
    places: Int64
    numbers: Int64
    points: Float
    amount: float


def same_people(tracks: Sequence[Track], views: int) -> tuple[list[list[int]], dict[Pair, float]]:
    """Sort tracks by person.

    Returns
    -------
    tuple
        The tracks (indices) of each person, those first who are seen most; and of each two tracks
        that were matched, how sure that is: 0 if another choice is as good, 1 at most.
    """
    of_view = [
        sorted((i for i, t in enumerate(tracks) if t.view == v), key=lambda i: -tracks[i].amount)
        for v in range(views)
    ]
    links: list[tuple[float, int, int]] = []
    sureness: dict[Pair, float] = {}
    for a, b in combinations(range(views), 2):
        compared = _Comparison(tracks, of_view[a][:LONGEST], of_view[b][:LONGEST])
        if compared.pairs:
            found, sure = compared.best()
            sureness |= sure
            links += [(worth * (0.01 + sure[i, j]), i, j) for (i, j), worth in found.items()]
    people = _joined(tracks, links)
    return sorted(people, key=lambda who: -sum(tracks[i].amount for i in who)), sureness


def epipolar_misfit(one: Float, other: Float) -> float | None:
    """Return how far two views of somebody are from one epipolar geometry, in pixels.

    Parameters
    ----------
    one, other
        (N, P, 2) pixels of the same frames, NaN where not detected.

    Returns
    -------
    float or None
        The median distance; None if too few points are seen by both.
    """
    both = located(one) & located(other)
    x, y = one[both], other[both]
    part = slice(None, None, max(1, -(-len(x) // POINTS)))
    x, y = x[part], y[part]
    if len(x) < FEWEST:
        return None
    size = float(x.std()) or 1.0
    a, b = (x - x.mean(0)) / size, (y - y.mean(0)) / size
    return float(np.median(_distances(_fundamental(a, b), a, b))) * size


def _joined(tracks: Sequence[Track], links: list[tuple[float, int, int]]) -> list[list[int]]:
    """Join tracks by their links, the strongest first; no one is in a camera twice at a time."""
    who = {i: [i] for i in range(len(tracks))}
    for _, i, j in sorted(links, reverse=True):
        one, other = who[i], who[j]
        if one is not other and not any(
            _together(tracks[k], tracks[m]) for k in one for m in other
        ):
            one += other
            who |= dict.fromkeys(other, one)
    return list({id(each): each for each in who.values()}.values())


def _together(one: Track, other: Track) -> bool:
    """Whether two tracks of a camera are there at the same time, so that they are two people."""
    return one.view == other.view and bool(np.isin(one.numbers, other.numbers).any())


class _Comparison:
    """The tracks of two cameras: the points that each two share, and how well these agree."""

    def __init__(self, tracks: Sequence[Track], left: list[int], right: list[int]) -> None:
        self.tracks = tracks
        one, other = (_scale([tracks[i] for i in side]) for side in (left, right))
        self.body = (one[2] + other[2]) / 2
        self.pairs: dict[Pair, tuple[Float, Float, Int64]] = {}
        self.together: dict[Pair, int] = {}  # frames
        for pair in product(left, right):
            x, y, frames = _shared(tracks[pair[0]], tracks[pair[1]])
            if len(x) >= FEWEST:
                self.pairs[pair] = (x - one[0]) / one[1], (y - other[0]) / other[1], frames
                numbers = [tracks[i].numbers for i in pair]
                self.together[pair] = np.intersect1d(numbers[0], numbers[1]).size

    def best(self) -> tuple[Matching, Matching]:
        """Return the best matching, and how sure each pair is: not at all if the cues disagree."""
        moving = self._by_frame()
        started = sorted(self.pairs, key=lambda pair: -self.together[pair])[:HYPOTHESES]
        tried = [self._static([pair]) for pair in started]
        tried += [self._static(list(found)) for _, found in [moving, *tried] if found]
        static = max(tried, key=_value)
        if _value(static) < STATIC * sum(self.together[pair] for pair in static[1]):
            return moving[1], self._sureness(moving, [])
        sure = self._sureness(static, tried)
        disputed = [pair for pair in sure if self._contradict({pair: 0.0}, moving[1])]
        return static[1], sure | dict.fromkeys(disputed, 0.0)

    def _sureness(self, best: Tried, tried: list[Tried]) -> Matching:
        """Return for each pair how much worse all is that contradicts it: from 0 to 1."""
        costs, found = best
        tried = tried + [(costs, self._matching(costs, without=pair)) for pair in found]
        sure = {}
        for pair in found:
            others = [_value(one) for one in tried if self._contradict({pair: 0.0}, one[1])]
            sure[pair] = 1 - max(others, default=0.0) / _value(best)
        return sure

    def _static(self, known: list[Pair]) -> Tried:
        """Return how well all pairs fit static cameras estimated from the known pairs."""
        x, y = (np.concatenate([self.pairs[pair][k] for pair in known]) for k in (0, 1))
        matrix = _fundamental(x, y)
        costs = {
            pair: float(np.minimum(_distances(matrix, x, y) / self.body, FAR).mean())
            for pair, (x, y, _) in self.pairs.items()
        }
        return costs, self._matching(costs)

    def _by_frame(self) -> Tried:
        """Return how far from rank three the pairs' frames are, whatever cameras do."""
        costs = {}
        for pair, (x, y, frames) in self.pairs.items():
            off = []
            for frame in np.unique(frames):
                both = np.concatenate([x[frames == frame], y[frames == frame]], axis=1)
                if len(both) > 5:
                    spread = np.linalg.svd(both - both.mean(0), compute_uv=False)[-1]
                    off.append(min(spread / np.sqrt(len(both) - 4) / self.body, FAR))
            costs[pair] = float(np.mean(off)) if off else FAR
        return costs, self._matching(costs)

    def _matching(self, costs: Costs, without: Pair | None = None) -> Matching:
        """Take the pairs of most benefit first: frames together, less what does not fit."""
        worth = {
            pair: self.together[pair] * (1 - cost / FAR)
            for pair, cost in costs.items()
            if pair != without and cost < FAR
        }
        found: Matching = {}
        for pair in sorted(worth, key=lambda pair: -worth[pair]):
            if not self._contradict({pair: 0.0}, found):
                found[pair] = worth[pair]
        return found

    def _contradict(self, one: Matching, other: Matching) -> bool:
        """Whether somebody is two people of the other camera at the same time."""
        return any(
            (i == k and j != m and _together(self.tracks[j], self.tracks[m]))
            or (j == m and i != k and _together(self.tracks[i], self.tracks[k]))
            for (i, j), (k, m) in product(one, other)
        )


def _value(tried: Tried) -> float:
    return sum(tried[1].values())


def _scale(tracks: list[Track]) -> tuple[Float, float, float]:
    """Return the centre and the size of all points of a camera, and the size of bodies in it."""
    points = np.concatenate([track.points for track in tracks])
    known = points[located(points)]
    size = float(known.std()) or 1.0
    with warnings.catch_warnings(action="ignore"):  # frames without points
        bodies = np.nanmax(np.nanmax(points, 1) - np.nanmin(points, 1), -1)
    return known.mean(0), size, float(np.nanmedian(bodies)) / size or 1.0


def _shared(one: Track, other: Track) -> tuple[Float, Float, Int64]:
    """Return the points (n, 2) that two tracks share, and the frame (n,) of each."""
    _, i, j = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    step = max(1, -(-len(i) // FRAMES))
    x, y = one.points[i[::step]], other.points[j[::step]]
    both = located(x) & located(y)
    frames = np.nonzero(both)[0]
    part = slice(None, None, max(1, -(-len(frames) // POINTS)))
    return x[both][part], y[both][part], frames[part]


def _fundamental(x: Float, y: Float) -> Float:
    """Return the fundamental matrix (3, 3) of points (n, 2), robust to outliers, of rank two."""
    a, b = _homogeneous(x), _homogeneous(y)
    rows = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
    weights = np.ones(len(rows))
    for _ in range(ROUNDS):
        _, vectors = np.linalg.eigh((rows * weights[:, None]).T @ rows)
        u, s, v = np.linalg.svd(vectors[:, 0].reshape(3, 3))
        matrix: Float = (u * (s[0], s[1], 0)) @ v
        off = _distances(matrix, x, y)
        slope = _slopes(matrix, a, b)
        weights = 1 / (slope + 1e-3 * slope.mean()) / (1 + (off / (3 * np.median(off) + 1e-9)) ** 2)
    return matrix


def _slopes(matrix: Float, a: Float, b: Float) -> Float:
    """Return the squared gradients (n,) of the epipolar constraint at points."""
    lines, back = a @ matrix.T, b @ matrix
    found: Float = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return found


def _distances(matrix: Float, x: Float, y: Float) -> Float:
    """Return Sampson's distances (n,) of points from their epipolar lines."""
    a, b = _homogeneous(x), _homogeneous(y)
    slope = np.maximum(_slopes(matrix, a, b), 1e-18)
    found: Float = np.abs((b @ matrix * a).sum(1)) / np.sqrt(slope)
    return found


def _homogeneous(points: Float) -> Float:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)
