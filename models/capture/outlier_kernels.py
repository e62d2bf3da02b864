"""Judging frames for outliers, compiled: see `models.capture.outliers`."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner, reordered
from models.numerics.matrices import copy, fill, total
from models.numerics.medians import MEDIAN_OF_SQUARES, median_of
from models.settings.keypoints import OUTLIER

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FAR = 6.0  # times the median distance from the median keypoint: outlier until more is known
MOST_LEVERAGE = 0.9  # largest leverage of an observation on its own prediction that is used


class Predictor(NamedTuple):
    """Predicts the coordinates y of a frame from those that are used, as F^T F y."""

    # (Q, Q + D): L^T, and F = L^-1 B^T, of L L^T = B^T B + noise^2 of what is used
    factors: Float64
    leverage: Float64  # (K, P, 2) what that of a coordinate changes by with it, were it used


class Judge(NamedTuple):
    """An `OutlierModel` of K views, with products that are computed once."""

    mean: Float64  # (K, P, 2)
    basis: Float64  # (D, Q) B; D = 2 K P
    products: Float64  # (Q, Q + D): B^T B, and B^T
    scales: Float64  # (K, P)
    freedom: float
    sides: Float64  # (K,)
    share: float
    noises: Float64  # (R,) of the rounds, falling


class Prepared(NamedTuple):
    """The predictors of frames in which every keypoint is observed."""

    coarse: Predictor  # with the first noise
    fine: Predictor  # with the last


class JudgingBuffers(NamedTuple):
    """Buffers for judging one frame. The first axis is the frame, of length 1."""

    predictor: Predictor
    offsets: Float64  # (1, K, P, 2) from the mean; 0 where not observed
    residuals: Float64  # (1, K, P, 2)
    squared: Float64  # (1, K, P)
    found: Float64  # (1, K, P)
    used: Bool  # (1, K, P)
    far: Bool  # (1, K, P)


@inner
def make_predictor(shape: tuple[int, int], size: int) -> Predictor:
    """Return an unfilled predictor for K views of P keypoints and Q components."""
    views, count = shape
    return Predictor(np.empty((size, size + 2 * views * count)), np.empty((views, count, 2)))


@compiled
def prepare(judge: Judge) -> Prepared:
    """Compute the predictors of frames in which every keypoint is observed."""
    shape, size = judge.scales.shape, len(judge.products)
    used = np.ones(shape, np.bool_)
    result = Prepared(make_predictor(shape, size), make_predictor(shape, size))
    predictor_into(judge, judge.noises[0], used, result.coarse)
    predictor_into(judge, judge.noises[-1], used, result.fine)
    return result


@inner
def predictor_into(judge: Judge, noise: float, used: Bool, out: Predictor) -> None:
    """Compute the predictor from the keypoints that are `used` (K, P), given their noise."""
    factors, size = out.factors, len(out.factors)
    copy(judge.products, factors)
    _use_only(judge.basis, used.ravel(), factors)
    leverage = out.leverage.ravel()
    fill(leverage, 0.0)
    for i in range(size):
        row = factors[i]
        row[i] += noise**2
        for k in range(0, i - i % 4, 4):  # four at a time are twice as fast
            a, b, c, d = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
            by_a, by_b, by_c, by_d = a[i], b[i], c[i], d[i]
            for j in range(len(row)):
                row[j] -= by_a * a[j] + by_b * b[j] + by_c * c[j] + by_d * d[j]
        for k in range(i - i % 4, i):
            a = factors[k]
            by_a = a[i]
            for j in range(len(row)):
                row[j] -= by_a * a[j]
        # No pivot is less than the variance of the noise, but by rounding.
        scale = 1.0 / math.sqrt(max(row[i], noise**2))
        for j in range(len(row)):
            row[j] *= scale
        done = row[size:]
        for j in range(len(done)):
            leverage[j] += done[j] * done[j]


@inner
def _use_only(basis: Float64, used: Bool, products: Float64) -> None:
    """Restrict B^T B to the keypoints that are used, by adding or subtracting the fewer."""
    size, sign = len(products), -1.0
    few = 2 * total(used) < len(used)
    if few:
        sign = 1.0
        for i in range(size):
            for j in range(size):
                products[i, j] = 0.0
    for v in range(len(used)):
        if used[v] == few:
            x, y = basis[2 * v], basis[2 * v + 1]
            for i in range(size):
                a, b, row = sign * x[i], sign * y[i], products[i, :size]
                for j in range(size):
                    row[j] += a * x[j] + b * y[j]


@compiled
def judge_frames_into(
    judge: Judge, prepared: Prepared, pixels: Float64, observed: Bool, out: Float64
) -> None:
    """Compute the probability of each keypoint (N, K, P) to be an outlier; NaN if not observed.

    Parameters
    ----------
    pixels, observed
        (N, K, P, 2), and (N, K, P) whether each was observed.
    """
    frames, views, count, _ = pixels.shape
    shape = (1, views, count)
    buffers = JudgingBuffers(
        make_predictor((views, count), len(judge.products)),
        np.empty((1, views, count, 2)),
        np.empty((1, views, count, 2)),
        np.empty(shape),
        np.empty(shape),
        np.empty(shape, np.bool_),
        np.empty(shape, np.bool_),
    )
    for n in range(frames):
        here = slice(n, n + 1)
        _judge_frame_into(judge, prepared, pixels[here], observed[here], buffers, out[here])
        for k in range(views):
            for p in range(count):
                if not observed[n, k, p]:
                    out[n, k, p] = np.nan


@inner
def _judge_frame_into(
    judge: Judge,
    prepared: Prepared,
    pixels: Float64,
    observed: Bool,
    buffers: JudgingBuffers,
    out: Float64,
) -> None:
    """Judge a frame, predicting from what is no outlier."""
    offsets = buffers.offsets.ravel()
    places, means, shown = pixels.ravel(), judge.mean.ravel(), observed.ravel()
    for d in range(len(offsets)):
        offsets[d] = places[d] - means[d] if shown[d // 2] else 0.0
    used, found = buffers.used.ravel(), buffers.found.ravel()
    copy(observed, buffers.used)
    if shown.all():
        _outlying_given(judge, prepared.coarse, observed, buffers, buffers.found)
        _outlying_given(judge, prepared.fine, observed, buffers, out)
    else:
        predictor_into(judge, judge.noises[0], observed[0], buffers.predictor)
        _outlying_given(judge, buffers.predictor, observed, buffers, buffers.found)
        predictor_into(judge, judge.noises[-1], observed[0], buffers.predictor)
        _outlying_given(judge, buffers.predictor, observed, buffers, out)
    if max(found.max(), out.max()) <= OUTLIER:  # where all together look right, they are
        return
    far_into(pixels, observed, buffers.far)
    far = buffers.far.ravel()
    for v in range(len(used)):
        used[v] = shown[v] and not far[v]
    for r in range(len(judge.noises)):
        predictor_into(judge, judge.noises[r], buffers.used[0], buffers.predictor)
        _outlying_given(judge, buffers.predictor, observed, buffers, out)
        found = out.ravel()
        for v in range(len(used)):
            used[v] = shown[v] and found[v] < OUTLIER


@inner
def _outlying_given(
    judge: Judge, given: Predictor, observed: Bool, buffers: JudgingBuffers, out: Float64
) -> None:
    """Judge the keypoints of a frame by a prediction from what is used."""
    _residuals_into(
        given.factors, buffers.offsets.ravel(), buffers.used.ravel(), buffers.residuals.ravel()
    )
    squared_errors_into(buffers.residuals, given.leverage, buffers.used, buffers.squared)
    outlying_into(
        buffers.squared, observed, judge.scales, judge.freedom, judge.sides, judge.share, out
    )


@reordered
def _residuals_into(factors: Float64, offsets: Float64, used: Bool, out: Float64) -> None:
    """Write how far coordinates (D,) are off their prediction."""
    size = len(factors)
    copy(offsets, out)
    for k in range(size):
        row, score = factors[k, size:], 0.0
        for d in range(len(row)):
            score += row[d] * (offsets[d] if used[d // 2] else 0.0)
        for d in range(len(row)):
            out[d] -= score * row[d]


@compiled
def squared_errors_into(residuals: Float64, leverage: Float64, used: Bool, out: Float64) -> None:
    """Write squared residuals (N, K, P), in each coordinate in units of its variance.

    Parameters
    ----------
    residuals
        (N, K, P, 2) of predictions, errors having variance 1.
    leverage
        (K, P, 2) what the prediction of a coordinate changes by with the coordinate, were it used.
    used
        (N, K, P) whether it was.
    """
    frames, views, count = used.shape
    for n in range(frames):
        for k in range(views):
            for p in range(count):
                out[n, k, p] = 0.0
                for i in range(2):
                    own = leverage[k, p, i]
                    more = -min(own, MOST_LEVERAGE) if used[n, k, p] else min(own, 1.0)
                    out[n, k, p] += residuals[n, k, p, i] ** 2 / (1.0 + more)


@compiled
def outlying_into(
    squared: Float64,
    observed: Bool,
    scales: Float64,
    freedom: float,
    sides: Float64,
    share: float,
    out: Float64,
) -> float:
    """Write how probably keypoints (N, K, P) are outliers, by their squared errors; 0 if unseen.

    Scales, freedom, sides and share are those of an `OutlierModel`. Returns the log likelihood of
    the errors.
    """
    frames, views, count = squared.shape
    relative = np.empty(views * count)
    # Half the square of a keypoint's error has the distribution F(2, freedom).
    median = freedom * (2.0 ** (2.0 / freedom) - 1.0)
    power, likelihood = -(freedom + 2.0) / 2.0, 0.0
    for n in range(frames):
        known = 0
        for k in range(views):
            for p in range(count):
                if observed[n, k, p]:
                    relative[known] = squared[n, k, p] / scales[k, p] ** 2
                    known += 1
        # In a frame that is unlike the others, all errors are larger.
        usual = max(median_of(relative[:known]), MEDIAN_OF_SQUARES) if known else MEDIAN_OF_SQUARES
        for k in range(views):
            anywhere = share / sides[k] ** 2
            for p in range(count):
                out[n, k, p] = 0.0
                if observed[n, k, p]:
                    spread = scales[k, p] ** 2 * usual / median
                    tail = (1.0 + squared[n, k, p] / (freedom * spread)) ** power
                    inlying = (1.0 - share) * tail / (2.0 * math.pi * spread)
                    out[n, k, p] = anywhere / (anywhere + inlying)
                    likelihood += math.log(anywhere + inlying)
    return likelihood


@compiled
def far_into(pixels: Float64, observed: Bool, out: Bool) -> None:
    """Write which observed keypoints (N, K, P) lie far from the others of their view."""
    frames, views, count, _ = pixels.shape
    seen, distances, middle = np.empty(count), np.empty(count), np.empty(2)
    for n in range(frames):
        for k in range(views):
            known = 0
            for i in range(2):
                known = 0
                for p in range(count):
                    if observed[n, k, p]:
                        seen[known] = pixels[n, k, p, i]
                        known += 1
                middle[i] = median_of(seen[:known]) if known else 0.0
            known = 0
            for p in range(count):
                distances[p] = math.hypot(
                    pixels[n, k, p, 0] - middle[0], pixels[n, k, p, 1] - middle[1]
                )
                if observed[n, k, p]:
                    seen[known] = distances[p]
                    known += 1
            limit = FAR * median_of(seen[:known]) if known else 0.0
            for p in range(count):
                out[n, k, p] = observed[n, k, p] and distances[p] > limit
