"""Outliers: keypoints far from where the other keypoints of their frame predict them.

All views of a frame, stacked into one vector, lie near a set of few dimensions, above all if the
cameras are static. Probabilistic PCA (Tipping & Bishop, 1999) therefore predicts a keypoint from
the others. Errors of inliers have Student's t distribution, with a scale for each view and keypoint
and the most likely degrees of freedom. Outliers lie anywhere in the view. Probable outliers are
left out and everything is learnt again, until little changes. Left and right keypoints that were
taken for each other are no outliers: they are swapped back.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import (
    Observations,
    as_observations,
    pixels_of,
    with_frames,
)
from models.capture.outlier_kernels import (
    Judge,
    far_into,
    judge_frames_into,
    outlying_into,
    prepare,
    squared_errors_into,
)
from models.capture.swapped_keypoints import find_pairs, put_right
from models.numerics.eigenvalues import falling_eigenvalues, white_eigenvalues
from models.numerics.medians import MEDIAN_OF_SQUARES
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import in_slices
from models.settings.keypoints import OUTLIER

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

OUTLIERS_KIND = "freedom"  # in files: with the degrees of freedom of inliers' errors
# Figures: evidence/keypoints.md.
OLD_FREEDOM = 6.0  # of older files
# That are tried. With fewer, more outliers would pass for inliers' tails; with more, keypoints of
# poses that the fit has not seen would pass for outliers.
FREEDOMS = (6.0, 9.0, 14.0)
LEAST_FRAMES = 40  # with fewer, what is usual is not known
MOST_FRAMES, MOST_NUMBERS = 4000, 1_000_000  # to learn it from: plenty, and what takes seconds
MOST_COORDINATES = 1200  # of a frame
MOST_COMPONENTS = 40
LEARNING_ROUNDS, FILLING_ROUNDS = 12, 4
SWAPPING_ROUNDS = 3  # of finding swapped keypoints, and learning without them
LEAST_PAIRS = 2  # that are swapped in the capture: a side has more than one keypoint
JUDGING_ROUNDS, FIRST_NOISE = 8, 0.05  # of a frame with outliers; of a view's side
LEAST_SCALE = 1e-3  # of the side of a view, what lens models and rounding leave
FIRST_SHARE, LEAST_SHARE, MOST_SHARE = 0.05, 0.001, 0.4  # of outliers among the keypoints
LEAST_SEEN = 10  # how often a keypoint of a view must be seen to have a scale of its own
FRAMES_AT_A_TIME = 64  # that a thread judges
# Frames of the fit that are judged one by one may have `MOST_TIMES` as many outliers as were
# learnt. Otherwise scales are made `WIDER`, for at most `WIDENING_ROUNDS`.
MOST_TIMES, WIDER, WIDENING_ROUNDS = 1.25, 1.5, 6
DIGITS = 3  # of probabilities, after the point: more would be noise, and long as text


class OutlierModel(NamedTuple):
    """y = mean + B z + e with z ~ N(0, 1), of all views of a frame; pixels."""

    mean: Float64  # (K, P, 2)
    basis: Float64  # (K, P, 2, Q)
    noise: float  # standard deviation of e in a coordinate while z is inferred
    scales: Float64  # (K, P) standard deviations of inliers' errors, were they Gaussian
    freedom: float  # degrees of freedom of Student's t, whose tails these errors have
    sides: Float64  # (K,) of the square that outliers lie in
    share: float  # of outliers among the keypoints
    pairs: Int64  # (S, 2) left and right keypoints that a view may show swapped

    def to_arrays(self) -> Arrays:
        """Return the model as tensors, for a file."""
        return as_tensors(self._asdict())

    @classmethod
    def shapes(cls, keypoints: int, kind: str) -> Shapes:
        """Shapes of what `to_arrays` returns, for P keypoints; None stands for any length.

        Files of older versions have the `kind` "pairs" and one fixed number of degrees of freedom.
        Still older ones have the `kind` "yes" and no pairs.
        """
        shapes: Shapes = {
            "mean": (None, keypoints, 2),
            "basis": (None, keypoints, 2, None),
            "noise": (1,),
            "scales": (None, keypoints),
            "sides": (None,),
            "share": (1,),
        }
        if kind in (OUTLIERS_KIND, "pairs"):
            shapes["pairs"] = (None, 2)
        if kind == OUTLIERS_KIND:
            shapes["freedom"] = (1,)
        return shapes

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "OutlierModel":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        mean, basis, scales, sides = (
            arrays[name].numpy() for name in ("mean", "basis", "scales", "sides")
        )
        noise, share = arrays["noise"].item(), arrays["share"].item()
        freedom = arrays["freedom"].item() if "freedom" in arrays else OLD_FREEDOM
        same = len(mean) == len(basis) == len(scales) == len(sides)
        positive = min(noise, freedom) > 0 and bool((scales > 0).all() and (sides > 0).all())
        pairs = arrays["pairs"].numpy() if "pairs" in arrays else np.empty((0, 2))
        indices = set(range(mean.shape[1])) & set(pairs.ravel().tolist())
        whole = len(indices) == pairs.size  # they are keypoints, and none is named twice
        if not same or not positive or not 0 < share < 1 or not whole:
            raise WeightsError("the file contradicts itself about outliers")
        return cls(mean, basis, noise, scales, freedom, sides, share, pairs.astype(np.int64))


class CleanedFrames(NamedTuple):
    """Frames without outliers, and which keypoints were outliers or swapped."""

    observations: Observations
    # (N, K, P), rounded; 1 of keypoints that were swapped, which are not where they were seen.
    probabilities: Float32
    swapped: Bool  # (N, K, P)
    # (N, K, P, 3): where the outliers are in pixels, and their confidences; 0 of all others.
    left_out: Float32


class OutlierJudge:
    """Judges frames of some views of a fit, each frame on its own."""

    def __init__(self, model: OutlierModel, views: Sequence[int]) -> None:
        chosen = list(views)
        mean, sides = model.mean[chosen], model.sides[chosen]
        # Learnt or read from a file, in one order of its numbers: each would be compiled apart.
        basis = np.ascontiguousarray(model.basis[chosen].reshape(mean.size, -1))  # (D, Q)
        # With little noise a prediction would follow outliers, so it begins with a lot.
        first = max(FIRST_NOISE * float(sides.mean()), model.noise)
        self._judge = Judge(
            mean,
            basis,
            np.hstack((basis.T @ basis, basis.T)),
            model.scales[chosen],
            model.freedom,
            sides,
            model.share,
            np.geomspace(first, model.noise, JUDGING_ROUNDS),
        )
        self._prepared = prepare(self._judge)
        self._pairs = model.pairs

    def find_pairs(self, observations: Observations) -> Int64:
        """Return the keypoints (S, 2) that are swapped in some of the frames: left and right."""
        return find_pairs(self._judge, self._prepared, observations)

    def put_right(self, observations: Observations) -> tuple[Observations, Bool]:
        """Swap back keypoints that were swapped; return also which these are (N, K, P)."""
        return put_right(self._judge, self._prepared, self._pairs, observations)

    def probabilities(self, observations: Observations) -> Float64:
        """Return the probability of each keypoint (N, K, P) to be an outlier; NaN if not observed.

        A frame whose keypoints are all unlike those of the fit has no outliers.
        """
        pixels, observed = pixels_of(observations)
        result = np.empty(observed.shape)

        def judge(part: slice) -> None:
            judge_frames_into(
                self._judge, self._prepared, pixels[part], observed[part], result[part]
            )

        in_slices(len(pixels), FRAMES_AT_A_TIME, judge)
        return result

    def without_outliers(self, observations: Observations) -> CleanedFrames:
        """Return the observations without outliers, with swapped keypoints swapped back.

        Keypoints whose probability to be outliers is above `OUTLIER` are left out.
        """
        observations, swapped = self.put_right(observations)
        probabilities = self.probabilities(observations).round(DIGITS).astype(np.float32)
        outliers = probabilities > OUTLIER
        probabilities[swapped] = 1
        if not outliers.any():
            return CleanedFrames(
                observations, probabilities, swapped, nothing_left_out(observations)
            )
        changed: Bool = np.logical_or.reduce(outliers, axis=(1, 2))
        some, out = observations.frames(changed), outliers[changed][..., None]
        pixels, left_out = pixels_of(some)[0], nothing_left_out(observations)
        there = np.concatenate((pixels, some.weights[..., None]), axis=-1, dtype=np.float32)
        left_out[changed] = np.where(out, there, 0)
        kept = as_observations(np.where(out, np.nan, pixels), some.weights)
        # Others stay to the last digit, so a frame's answer never depends on the frames beside it.
        return CleanedFrames(
            with_frames(observations, changed, kept), probabilities, swapped, left_out
        )


def nothing_left_out(observations: Observations) -> Float32:
    """Return `left_out` of frames of which everything is used."""
    return np.zeros((*observations.weights.shape, 3), np.float32)


def learn_outliers(observations: Observations) -> OutlierModel | None:
    """Learn the distribution of keypoints that are no outliers; None if that is not possible.

    It takes at least 40 frames, of at most 1200 coordinates.
    """
    pairs = np.empty((0, 2), np.int64)
    model = _learn(observations, pairs)
    for _ in range(SWAPPING_ROUNDS):
        if model is None:
            break
        judge = OutlierJudge(model, range(len(model.mean)))
        more = judge.find_pairs(judge.put_right(observations)[0])
        more = more[~np.isin(more, pairs).any(1)]
        if not len(more) or len(pairs) + len(more) < LEAST_PAIRS:
            break
        pairs = np.concatenate((pairs, more))
        judge = OutlierJudge(model._replace(pairs=pairs), range(len(model.mean)))
        model = _learn(judge.put_right(observations)[0], pairs)
    return None if model is None else _more_careful(model, observations)


def _more_careful(model: OutlierModel, observations: Observations) -> OutlierModel:
    """Widen the scales until frames judged one by one have as many outliers as were learnt.

    A model explains the frames it was learnt from too well, above all where few keypoints of each
    are observed. Its scales are then too narrow, and correct keypoints would count as outliers.
    """
    judge = OutlierJudge(model, range(len(model.mean)))
    every = math.ceil(len(observations.weights) / MOST_FRAMES)
    some = observations.frames(slice(None, None, every))
    observations = judge.put_right(some)[0]
    observed = np.count_nonzero(observations.weights)
    for _ in range(WIDENING_ROUNDS):
        outliers = np.count_nonzero(judge.probabilities(observations) > OUTLIER)
        if outliers <= MOST_TIMES * model.share * observed:
            break
        model = model._replace(scales=WIDER * model.scales)
        judge = OutlierJudge(model, range(len(model.mean)))
    return model


def _learn(observations: Observations, pairs: Int64) -> OutlierModel | None:
    """Learn from keypoints of which none is swapped any more."""
    pixels, observed = pixels_of(observations)
    views, count = observed.shape[1:]
    width = 2 * views * count  # D, 0 where no view shows anything
    if not 0 < width <= MOST_COORDINATES:
        return None
    frames = np.flatnonzero(observed.any((1, 2)))
    frames = frames[:: max(1, -(-len(frames) // min(MOST_FRAMES, MOST_NUMBERS // width)))]
    if len(frames) < LEAST_FRAMES:
        return None
    pixels, observed = pixels[frames], observed[frames]
    shape, sides = (views, count, 2), _sides(pixels, observed)
    far = np.empty_like(observed)
    far_into(pixels, observed, far)
    far &= far.sum(0) <= FIRST_SHARE * observed.sum(0)  # else it belongs there
    used, share = observed & ~far, FIRST_SHARE
    given = np.where(observed[..., None], pixels, 0).reshape(len(frames), width)
    known = np.repeat(used.reshape(len(frames), -1), 2, axis=1)
    means = np.where(known, given, 0).sum(0) / known.sum(0).clip(1)
    filled = np.where(known, given, means)
    shown = 2 * int(observed.any(0).sum())  # coordinates; those never observed do not vary
    white = white_eigenvalues(len(frames), shown)
    rank = min(len(frames) - 1, shown)
    half = slice(rank // 2, rank)
    squared, outlying = np.empty(observed.shape), np.empty(observed.shape)
    for _ in range(LEARNING_ROUNDS):
        for _ in range(FILLING_ROUNDS):
            mean = filled.mean(0)
            values, vectors = falling_eigenvalues(filled - mean)
            variance = max(values[half].mean() / white[half].mean(), 1e-12)
            kept = values > variance * (1 + np.sqrt(shown / len(frames))) ** 2
            kept[MOST_COMPONENTS:] = False
            basis, gains = vectors[:, kept], 1 - variance / values[kept]
            predicted = mean + ((filled - mean) @ basis * gains) @ basis.T
            filled = np.where(known, given, predicted)
        leverage = (np.square(basis) @ gains).reshape(shape)
        residuals = (given - predicted).reshape(len(frames), *shape)
        squared_errors_into(residuals, leverage, used, squared)
        scales = _scales(squared, used, sides)
        freedom = max(
            FREEDOMS,
            key=lambda f: outlying_into(squared, observed, scales, f, sides, share, outlying),
        )
        outlying_into(squared, observed, scales, freedom, sides, share, outlying)
        share = float((outlying.sum() / observed.sum()).clip(LEAST_SHARE, MOST_SHARE))
        used = observed & (outlying < OUTLIER)
        known = np.repeat(used.reshape(len(frames), -1), 2, axis=1)
    spread = basis * np.sqrt(values[kept] - variance)
    return OutlierModel(
        mean.reshape(shape),
        spread.reshape(*shape, -1),
        float(np.sqrt(variance)),
        scales,
        freedom,
        sides,
        share,
        pairs,
    )


def _sides(pixels: Float64, observed: Bool) -> Float64:
    """Return the longer side of what every view (K,) shows of all frames."""
    low = np.where(observed[..., None], pixels, np.inf).min((0, 2))
    high = np.where(observed[..., None], pixels, -np.inf).max((0, 2))
    sides = (high - low).max(-1)
    return np.where(np.isfinite(sides), sides, 1.0).clip(1e-6)


def _median(numbers: Float64, shown: Bool) -> Float64:
    """Return the lower median of what is shown along the last axis; 0 where nothing is."""
    ordered = np.sort(np.where(shown, numbers, np.inf), axis=-1)
    middle = (shown.sum(-1, keepdims=True) - 1).clip(0) // 2
    found = np.take_along_axis(ordered, np.broadcast_to(middle, (*ordered.shape[:-1], 1)), -1)
    return np.where(np.isfinite(found), found, 0)[..., 0]


def _scales(squared: Float64, used: Bool, sides: Float64) -> Float64:
    """Return the scale of the errors of every keypoint of every view (K, P)."""
    medians = _median(squared.transpose(1, 2, 0), used.transpose(1, 2, 0)) / MEDIAN_OF_SQUARES
    medians[used.sum(0) < LEAST_SEEN] = np.nan
    pooled = float(np.nanmedian(medians)) if np.isfinite(medians).any() else 0.0
    scales = np.sqrt(np.sqrt(np.where(np.isfinite(medians), medians, pooled) * pooled))
    return np.maximum(scales, LEAST_SCALE * sides[:, None])
