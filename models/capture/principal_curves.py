"""Curves through the poses of a capture, found without knowing when frames were taken.

A subject goes from pose to pose, so its frames lie along a curve, in whatever order they come. A
mixture of Gaussians does not use this. Here the centres of a mixture are close to each other and
lie on a curve that bends little: a principal curve (Hastie and Stuetzle, 1989) as a mixture
(Tibshirani, *Principal curves revisited*, 1992). Its points are estimated in all coordinates, from
the frames around them, so it also follows small motions that no principal component shows.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.heavy_tails import ROUNDS_OF_TAILS, clip_into
from models.numerics.chains import smooth_chain
from models.numerics.compiled import compiled

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

# Figures: evidence/noise.md.
FRAMES_PER_STOP = (3, 5, 8)  # through whose means a curve is first led: three curves
FRAMES_PER_POINT = 2  # of a curve, if that makes more than `PLENTY`
PLENTY, MOST_POINTS = 500, 1000  # of a curve; fewer only if there are fewer frames
MOST_NUMBERS = 1_000_000  # coordinates of the points of all curves together
MOST_DIMENSIONS = 128  # leading components in which curves are learnt
MEANS_ROUNDS = 10  # of k-means
SWEEPS = 50  # over a path, to make it shorter
ROUNDS = 20  # of expectation maximisation
DEGREES = 4.0  # of freedom of second differences: now and then the subject turns sharply
FEW = 0.1  # frames that a point counts for, if it has none
LEAST_RATE = 1e-3  # by which any component bends, as a share of the one that bends most
TINY = 1e-9  # variance of second differences, in variances of the noise
NEGLIGIBLE = 30.0  # log probability, less than that of the most probable point


class PrincipalCurves(NamedTuple):
    """M points of curves through poses, in standard deviations of the noise from their mean."""

    points: Float64  # (K, P, 2, M)
    heights: Float64  # (M,) log probability, less what is not known of the point
    share: float  # of the curves in an expected frame; the remainder is the mixture's


def no_curves(views: int, keypoints: int) -> PrincipalCurves:
    """Return curves without points."""
    return PrincipalCurves(np.zeros((views, keypoints, 2, 0)), np.zeros(0), 0.0)


class LearntCurves(NamedTuple):
    """Points of curves, and the expectation of the frames they were learnt from."""

    points: Float64  # (M, D)
    heights: Float64  # (M,)
    expected: Float64  # (N, D)
    freedom: float  # degrees of freedom of a frame's expectation


def learn_curves(offsets: Float64, expected: Float64, dimensions: int) -> LearntCurves | None:
    """Learn curves from frames with white noise of variance 1; None if there are too few.

    The outcome does not depend on the order of the frames, but for rounding.

    Parameters
    ----------
    offsets
        (N, D) coordinates less their mean, D < N or not.
    expected
        (N, D) what they are without most of their noise: the curves begin from there.
    dimensions
        How many leading components decide which frames are neighbours.
    """
    frames, width = offsets.shape
    count = max(min(frames // FRAMES_PER_POINT, MOST_POINTS), min(frames, PLENTY))
    count = min(count, MOST_NUMBERS // (len(FRAMES_PER_STOP) * width))
    stops = [frames // each for each in FRAMES_PER_STOP]
    if min(stops) < 3 or count < min(stops):
        return None
    vectors = np.linalg.svd(offsets, full_matrices=False)[2].T[:, :MOST_DIMENSIONS]  # (D, Q)
    given, start = offsets @ vectors, expected @ vectors
    curves = [_learn(given, start, dimensions, number, count) for number in stops]
    points = np.concatenate([curve.points for curve in curves])
    heights = np.concatenate([curve.heights for curve in curves])
    belongs = _belongs(given, points, heights)
    means = belongs @ points
    spread = belongs @ np.square(points).sum(1) - np.square(means).sum(1)
    freedom = float(spread.mean() + np.mean([curve.leverage for curve in curves]))
    return LearntCurves(points @ vectors.T, heights, means @ vectors.T, freedom)


class _Curve(NamedTuple):
    """One curve: its points (M, Q), their heights (M,), and its leverage."""

    points: Float64
    heights: Float64
    leverage: float  # degrees of freedom of a frame due to its own influence on the points


def _learn(given: Float64, start: Float64, dimensions: int, stops: int, count: int) -> _Curve:
    """Learn a curve of `count` points, starting along `stops` means of `start` (N, Q).

    The rate at which it bends in each component is found by MacKay's fixed point (*Bayesian
    Interpolation*, 1992), and the places where it bends more by expectation maximisation.
    """
    points = _along(_shortest_path(_means(start, dimensions, stops)), count)
    bends = np.square(np.diff(points, 2, axis=0))
    scales, rates, heights = np.ones(len(bends)), _at_least(bends.mean(0)), np.zeros(count)
    for _ in range(ROUNDS):
        belongs = _belongs(given, points, heights)
        frames = belongs.sum(0)
        chain = smooth_chain(belongs.T @ given, frames, rates, scales)
        points = chain.points
        shares = (frames + FEW) / (frames + FEW).sum()
        heights = np.log(shares) - chain.variances.sum(1) / 2
        # The rate is the sum of squared bends divided by the number of bends the frames determine.
        bends, scaled = np.square(np.diff(points, 2, axis=0)), scales[:, None]
        determined = (1 - chain.doubts / (scaled * rates)).sum(0)
        rates = _at_least((bends / scaled).sum(0) / determined.clip(TINY))
        width = len(rates)
        scales = (((bends + chain.doubts) / rates).sum(1) + DEGREES) / (width + DEGREES)
        scales *= np.mean(1 / scales)  # a factor of all belongs to the rates
    leverage = float((np.square(belongs) @ chain.variances.sum(1)).mean())
    return _Curve(points, heights, leverage)


def _at_least(rates: Float64) -> Float64:
    """Return rates with a lower limit: by likelihood alone, the smallest would go to zero."""
    return np.asarray(np.maximum(rates, LEAST_RATE * rates.max() + TINY))


def _belongs(given: Float64, points: Float64, heights: Float64) -> Float64:
    """Return the probabilities (N, M) that frames (N, Q) belong to points (M, Q)."""
    logs = given @ points.T + (heights - np.square(points).sum(1) / 2)
    belongs = np.exp(logs - logs.max(1, keepdims=True))
    belongs /= belongs.sum(1, keepdims=True)
    return np.asarray(belongs)


def _means(frames: Float64, dimensions: int, count: int) -> Float64:
    """Return at most `count` means (M, Q) of frames (N, Q), alike in their leading dimensions.

    K-means from frames that are far from each other (Gonzalez, 1985), the first from the mean.
    """
    leading = frames[:, :dimensions]
    chosen = [int(np.square(leading - leading.mean(0)).sum(1).argmax())]
    distances = np.full(len(leading), np.inf)
    while len(chosen) < count:
        distances = np.minimum(distances, np.square(leading - leading[chosen[-1]]).sum(1))
        chosen.append(int(distances.argmax()))
    centres = leading[chosen]
    for _ in range(MEANS_ROUNDS):
        nearest = (np.square(centres).sum(1) - 2 * leading @ centres.T).argmin(1)
        there, nearest = np.unique(nearest, return_inverse=True)
        centres = _grouped(leading, nearest, len(there))
    return _grouped(frames, nearest, len(there))


def _grouped(frames: Float64, groups: Int64, count: int) -> Float64:
    """Return the means (count, Q) of groups of frames, none of which is empty."""
    sums = np.zeros((count, frames.shape[1]))
    np.add.at(sums, groups, frames)
    return sums / np.bincount(groups, minlength=count)[:, None]


def _shortest_path(points: Float64) -> Float64:
    """Return the points (M, Q) in the order of a short path through all of them.

    From the two that are farthest from each other the nearest is followed, and then parts are
    turned round as long as that helps (2-opt: Croes, 1958).
    """
    squares = np.square(points).sum(1)
    distances = np.sqrt((squares[:, None] + squares - 2 * points @ points.T).clip(0))
    paths = []
    for first in np.unravel_index(distances.argmax(), distances.shape):
        path, left = [int(first)], distances.copy()
        while len(path) < len(points):
            left[:, path[-1]] = np.inf
            path.append(int(left[path[-1]].argmin()))
        paths.append(_shortened(np.array(path), distances))
    lengths = [distances[path[1:], path[:-1]].sum() for path in paths]
    return points[paths[int(np.argmin(lengths))]]


def _shortened(path: Int64, distances: Float64) -> Int64:
    """Turn parts of a path round until no such turn makes it shorter."""
    path, count = path.copy(), len(path)
    for _ in range(SWEEPS):
        turned = False
        for begin in range(count - 1):
            ends = np.arange(begin + 1, count)
            after = path[np.minimum(ends + 1, count - 1)]  # of the last nothing comes after
            inside = ends + 1 < count
            gain = np.where(inside, distances[path[ends], after], 0.0)
            gain -= np.where(inside, distances[path[begin], after], 0.0)
            if begin > 0:
                before = path[begin - 1]
                gain += distances[before, path[begin]] - distances[before, path[ends]]
            best = int(gain.argmax())
            if gain[best] > 1e-9 * distances.max():
                path[begin : ends[best] + 1] = path[begin : ends[best] + 1][::-1].copy()
                turned = True
        if not turned:
            break
    return path


def _along(path: Float64, count: int) -> Float64:
    """Return `count` points (M, Q) at equal distances along a path."""
    places = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))))
    wanted = np.linspace(0, places[-1], count)
    return np.stack([np.interp(wanted, places, values) for values in path.T], axis=1)


@compiled
def expect_on_curves_into(
    points: Float64,
    heights: Float64,
    rows: Int64,
    offsets: Float64,
    observed: Bool,
    tails: float,
    out: Float64,
) -> None:
    """Write the expected coordinates (N, D) of frames of which a part is observed.

    Noise with heavy tails is taken into account as by `clip_into`.

    Parameters
    ----------
    points, heights
        (C, M) and (M,) of curves in all coordinates there are.
    rows
        (D,) which of these coordinates the frames show.
    offsets, observed
        (N, D) coordinates minus their mean, and whether they were observed.
    tails
        One over the degrees of freedom of the noise; 0 if it is Gaussian.
    """
    count = len(heights)
    logs, probable = np.empty(count), np.empty(count, np.int64)
    for n in range(len(offsets)):
        clipped = offsets[n].copy()
        for i in range(ROUNDS_OF_TAILS if tails > 0.0 else 1):
            if i > 0:
                clip_into(offsets[n], out[n], tails, clipped)
            logs[:] = heights
            for d in range(len(rows)):
                if observed[n, d]:
                    row, number = points[rows[d]], clipped[d]
                    for m in range(count):
                        logs[m] -= 0.5 * (number - row[m]) ** 2
            most, found, total = logs.max(), 0, 0.0
            for m in range(count):
                if logs[m] > most - NEGLIGIBLE:
                    logs[found] = np.exp(logs[m] - most)
                    total += logs[found]
                    probable[found] = m
                    found += 1
            for d in range(len(rows)):
                row, expected = points[rows[d]], 0.0
                for m in range(found):
                    expected += logs[m] * row[probable[m]]
                out[n, d] = expected / total
