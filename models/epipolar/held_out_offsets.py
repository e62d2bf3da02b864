"""What speaks for one offset of a view and against another, judged by what no fit has seen.

Two offsets are compared on frames that both of them have, and the cameras are fitted alike for
both. They may be static, with one fundamental matrix for all frames, or move: a matrix for each
stretch of frames, or affine cameras for each frame. A matrix is judged by other frames than it was
fitted to, or by other keypoints of its frames, so one that bends to the keypoints gains nothing.
Each offset has the cameras that suit it best.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.tracks import masked_median, motion_at
from models.epipolar.fundamental import (
    robust_costs,
    sampson_distances,
    student_weights,
)
from models.epipolar.offset_refinement import FLOOR, TrackedFrames
from models.epipolar.taubin import gradients_of, reduced
from models.numerics.medians import NORMAL
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FOLDS = 4
TIME_FOLDS = 2 * FOLDS  # stretches of time: every fourth is held out together
FRAMES = 60  # that two offsets are compared on, for each way to pair them
LEAST_FRAMES = 24
ROUGH_FRAMES, ROUGH_PARTNERS = 36, 2
AS_WELL = 0.05  # nats
STRETCHES = ((12, False), (3, False))  # frames that a matrix of moving cameras is for, none affine
ROUNDS = 4
SCALE_ROUNDS = 6
BLOCKS = 10  # of frames, whose gains are compared
PARTNERS = 3  # views that a view's offset is judged by
AFFINE = np.array([8, 8, 2, 8, 8, 3, 0, 1, 4])  # entries of a matrix; 8: none


class Offsets(NamedTuple):
    """When the views are read: views (K,) by frames, and one of them by a function of time."""

    view: int
    of_view: Float64  # (N,) frames, at each moment
    others: Float64  # (K,) frames

    def times(self, view: int, moments: Float64) -> Float64:
        """Return in which of its frames a view shows the moments (T,)."""
        if view != self.view:
            return np.asarray(moments + self.others[view], np.float64)
        late = np.interp(moments, np.arange(len(self.of_view)), self.of_view)
        return np.asarray(moments + late, np.float64)

    def moments(self, view: int, times: Float64) -> Float64:
        """Return the moments (T,) that a view shows in its frames `times`."""
        if view != self.view:
            return np.asarray(times - self.others[view], np.float64)
        every = np.arange(len(self.of_view), dtype=np.float64)
        late = np.interp(times, every + self.of_view, self.of_view)
        return np.asarray(times - late, np.float64)


def gain_of(
    tracked: TrackedFrames, better: Offsets, than: Offsets, *, roughly: bool = False
) -> Float64 | None:
    """Return how much less keypoints cost with one offset than with another, for blocks (B,).

    In nats of a keypoint of a pair of views, the mean over the view's partners; `roughly` from
    fewer frames, partners and kinds of cameras. None if both offsets share too few frames.
    """
    view, count = better.view, len(better.of_view)
    most = ROUGH_FRAMES if roughly else FRAMES
    gains = []
    for other in partners_of(tracked, view)[: ROUGH_PARTNERS if roughly else None]:
        for kept in (other,) if roughly else (other, view):  # whose frames both offsets read
            times = np.arange(count, dtype=np.float64)
            with_both = _inside(better, kept, times, (view, other))
            with_both &= _inside(than, kept, times, (view, other))
            times = _thinned(times[with_both], most)
            if len(times) < LEAST_FRAMES:
                continue
            lesser, more = (
                best_costs(tracked, o, (view, other), o.moments(kept, times), roughly=roughly)
                for o in (better, than)
            )
            if np.isfinite(lesser).any() and np.isfinite(more).any():
                gains.append(_in_blocks(more - lesser))
    return np.mean(gains, 0) if gains else None


def certainty_of(gains: Float64) -> float:
    """Return the mean of gains (B,) in standard errors of Student's t, as a Gaussian has them."""
    count = len(gains)
    error = float(gains.std(ddof=1)) / float(np.sqrt(count)) + TINY
    return float(float(gains.mean()) / error * (count - 3) / count)


def of_static_cameras(tracked: TrackedFrames, offsets: Offsets) -> bool:
    """Whether static cameras explain a view and its partners as well as any that move."""
    static, best = [], []
    for other in partners_of(tracked, offsets.view):
        moments = np.arange(len(offsets.of_view), dtype=np.float64)
        inside = _inside(offsets, other, moments, (offsets.view, other))
        moments = offsets.moments(other, _thinned(moments[inside], FRAMES))
        if len(moments) >= LEAST_FRAMES:
            costs = [
                float(np.nanmean(cost))
                for cost in _costs_of(tracked, offsets, (offsets.view, other), moments)
            ]
            static.append(costs[0])
            best.append(min(costs))
    return bool(static) and float(np.mean(static)) < float(np.mean(best)) + AS_WELL


def partners_of(tracked: TrackedFrames, view: int) -> list[int]:
    """Return the views that share most keypoints with a view."""
    seen = [(track.weights > 0).sum(1) for track in tracked.tracks]
    shared = np.array([float(np.minimum(seen[view], other).sum()) for other in seen])
    shared[view] = 0
    order = np.argsort(-shared, kind="stable")[:PARTNERS]
    return [int(other) for other in order if shared[other] > 0]


def best_costs(
    tracked: TrackedFrames,
    offsets: Offsets,
    pair: tuple[int, int],
    moments: Float64,
    *,
    roughly: bool = False,
) -> Float64:
    """Return the costs (T,) of a pair at moments, with the cameras that suit it best."""
    costs = _costs_of(tracked, offsets, pair, moments, roughly=roughly)
    return min(costs, key=lambda cost: float(np.nansum(cost)))


def _costs_of(
    tracked: TrackedFrames,
    offsets: Offsets,
    pair: tuple[int, int],
    moments: Float64,
    *,
    roughly: bool = False,
) -> list[Float64]:
    """Return the costs (T,) with static cameras, and with all kinds of moving ones."""
    x, y = (
        motion_at(tracked.tracks[view], offsets.times(view, moments), tracked.half_width).places
        for view in pair
    )
    there = np.asarray(np.isfinite(x).all(-1) & np.isfinite(y).all(-1))
    x, y = (np.where(there[..., None], points, 0.0) for points in (x, y))
    kinds = [(len(x), False), (1, True)] if roughly else [(len(x), False), *STRETCHES, (1, True)]
    return [_costs(_held_out(x, y, there, many, affine=affine), there) for many, affine in kinds]


def _thinned(times: Float64, most: int) -> Float64:
    places = np.linspace(0, len(times) - 1, min(most, len(times)))
    return np.asarray(times[places.astype(int)], np.float64)


def _inside(offsets: Offsets, kept: int, times: Float64, pair: tuple[int, int]) -> Bool:
    """Return which frames (T,) of a view show moments that both views of a pair have."""
    moments, last = offsets.moments(kept, times), len(times) - 1
    read = np.stack([offsets.times(view, moments) for view in pair])
    return np.asarray(((read >= 0) & (read <= last)).all(0))


def _in_blocks(gains: Float64) -> Float64:
    blocks = np.array_split(gains, BLOCKS)
    known = [np.isfinite(block) for block in blocks]
    means = [
        block[there].mean() if there.any() else 0.0
        for block, there in zip(blocks, known, strict=True)
    ]
    return np.array(means)


def _costs(distances: Float64, there: Bool) -> Float64:
    """Mean negative log likelihood (T,) of distances (T, P), of the likeliest scale."""
    scale, count = FLOOR, max(int(there.sum()), 1)
    if there.any():
        scale = max(NORMAL * float(np.median(np.abs(distances[there]))), FLOOR)
    for _ in range(SCALE_ROUNDS):
        weighted = student_weights(distances, scale) * np.square(distances) * there
        scale = max(float(np.sqrt(weighted.sum() / count)), FLOOR)
    shown = there.sum(1)
    costs = (robust_costs(distances, scale) * there).sum(1) / np.maximum(shown, 1)
    return np.where(shown > 0, costs, np.nan)


def _held_out(x: Float64, y: Float64, there: Bool, stretch: int, *, affine: bool) -> Float64:
    """Return the distances (T, P) of keypoints from matrices that were fitted to others.

    A matrix for all frames is fitted to other frames; one for a stretch of them, to other
    keypoints.
    """
    count, points = there.shape
    stretches = -(-count // stretch)
    lacking = stretches * stretch - count

    def cut(array: Float64) -> Float64:
        padded = np.pad(array, ((0, lacking), *((0, 0),) * (array.ndim - 1)))
        return padded.reshape(stretches, stretch * points, *array.shape[2:])

    if stretches == 1:
        fold = np.repeat(np.arange(stretch) * TIME_FOLDS // stretch % FOLDS, points)
    else:
        fold = np.tile(np.random.default_rng(0).permutation(points) % FOLDS, stretch)
    x, y, weights = cut(x), cut(y), cut(there.astype(np.float64))
    distances = np.empty(weights.shape)
    matrices = _fit(x, y, weights, fold, affine=affine)  # (S, FOLDS, 3, 3)
    for number in range(FOLDS):
        out = fold == number
        distances[:, out] = sampson_distances(matrices[:, number], x[:, out], y[:, out])
    return distances.reshape(-1, points)[:count]


def _fit(
    x: Float64, y: Float64, weights: Float64, fold: NDArray[np.int64], *, affine: bool
) -> Float64:
    """Fit matrices (S, F, 3, 3), robustly, to what F folds leave of points x, y (S, M, 2)."""
    train = weights[:, None] * (fold != np.arange(FOLDS)[:, None])  # (S, F, M)
    total = np.maximum(weights.sum(1), 1)[:, None, None]
    to_x, to_y = ((points * weights[..., None]).sum(1, keepdims=True) / total for points in (x, y))
    x, y = x - to_x, y - to_y
    spread = (np.square(x) + np.square(y)).sum(-1) * weights
    unit = np.sqrt(spread.sum(1) / (4 * total[:, 0, 0]))[:, None, None] + TINY
    one = np.ones((*x.shape[:-1], 1))
    hx, hy = np.concatenate((x / unit, one), -1), np.concatenate((y / unit, one), -1)
    if affine:
        rows = np.concatenate((hx[..., :2], hy), -1)
    else:
        rows = (hy[..., :, None] * hx[..., None, :]).reshape(*x.shape[:-1], 9)
    robust = train
    for round_ in range(ROUNDS):
        normal = _products(rows, robust)
        if affine:
            gradients = robust.sum(-1)[..., None, None] * np.eye(4)
        else:
            gradients = gradients_of(_products(hx, robust), _products(hy, robust))
        vectors = reduced(normal, gradients).best()  # (S, F, q)
        if affine:
            vectors = np.concatenate((vectors, np.zeros_like(vectors[..., :4])), -1)[..., AFFINE]
        matrices = vectors.reshape(*vectors.shape[:2], 3, 3)
        if round_ == ROUNDS - 1:
            break
        distances = _distances(matrices, hx, hy)
        absolute = np.where(train > 0, np.abs(distances), np.nan)
        scales = np.maximum(np.nan_to_num(NORMAL * masked_median(absolute)), TINY)[..., None]
        robust = train * student_weights(distances, scales)
    back_x, back_y = (_centring(to, unit) for to in (to_x, to_y))
    return back_y.mT[:, None] @ matrices @ back_x[:, None]


def _products(rows: Float64, weights: Float64) -> Float64:
    """Sum weight x row row^T over the points: (S, F, q, q) of rows (S, M, q), weights (S, F, M)."""
    return (rows[:, None] * weights[..., None]).mT @ rows[:, None]


def _distances(matrices: Float64, hx: Float64, hy: Float64) -> Float64:
    """Sampson distances (S, F, M) of homogeneous points (S, M, 3)."""
    lines_y, lines_x = hx[:, None] @ matrices.mT, hy[:, None] @ matrices
    squares = np.square(lines_y[..., :2]).sum(-1) + np.square(lines_x[..., :2]).sum(-1)
    errors: Float64 = (lines_y * hy[:, None]).sum(-1) / np.sqrt(squares + TINY**2)
    return errors


def _centring(centre: Float64, unit: Float64) -> Float64:
    """Return the similarities (S, 3, 3) that take centres (S, 1, 2) to 0, units (S, 1, 1) to 1."""
    found = np.zeros((len(centre), 3, 3))
    found[:, 0, 0] = found[:, 1, 1] = 1 / unit[:, 0, 0]
    found[:, :2, 2] = -centre[:, 0] / unit[:, 0]
    found[:, 2, 2] = 1
    return found
