"""Outliers: keypoints that lie where the rest of their frame says that they cannot be.

All views of a frame, stacked into one vector, lie near a set of few dimensions, more so if cameras
rest. Probabilistic PCA (Tipping & Bishop, 1999) therefore predicts a keypoint from the others. How
far inliers are off is told by Student's t, with a scale for each view and keypoint; outliers lie
anywhere in the view. What is probably an outlier takes no part, and everything is learnt anew.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from models.capture.observations import Observations, as_observations, pixels_of
from models.numerics.eigenvalues import falling_eigenvalues, white_eigenvalues
from models.numerics.tensor_files import Arrays, Shapes, WeightsError
from models.numerics.threads import in_slices

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_FRAMES = 40  # with fewer, what is usual is not known
MOST_FRAMES, MOST_NUMBERS = 4000, 1_000_000  # to learn it from: plenty, and what takes seconds
MOST_COORDINATES = 1200  # of a frame
MOST_COMPONENTS = 40
LEARNING_ROUNDS, FILLING_ROUNDS = 12, 4
JUDGING_ROUNDS, FIRST_NOISE = 8, 0.05  # of a frame with outliers; of a view's side
FREEDOM = 6.0  # of Student's t: errors of inliers have tails
LEAST_SCALE = 1e-3  # of the side of a view, what lens models and rounding leave
FIRST_SHARE, LEAST_SHARE, MOST_SHARE = 0.05, 0.001, 0.4  # of outliers among the keypoints
FAR = 6.0  # times the median distance from the median keypoint: outlier until more is known
MOST_LEVERAGE = 0.9  # of an observation on its own prediction that is reckoned with
MEDIAN_OF_SQUARES = 2 * np.log(2)  # of two coordinates with variance 1
LEAST_SEEN = 10  # how often a keypoint of a view must be seen to have a scale of its own
FRAMES_AT_A_TIME = 64


class OutlierModel(NamedTuple):
    """y = mean + B z + e with z ~ N(0, 1), of all views of a frame; pixels."""

    mean: Float64  # (K, P, 2)
    basis: Float64  # (K, P, 2, Q)
    noise: float  # standard deviation of e in a coordinate while z is inferred
    scales: Float64  # (K, P) of inliers' errors
    sides: Float64  # (K,) of the square that outliers lie in
    share: float  # of outliers among the keypoints

    def to_arrays(self) -> Arrays:
        """Return the model as tensors, for a file."""
        parts = self._asdict().items()
        return {n: torch.from_numpy(np.array(v, np.float64, ndmin=1, order="C")) for n, v in parts}

    @classmethod
    def shapes(cls, keypoints: int) -> Shapes:
        """Shapes of what `to_arrays` returns, for P keypoints; None stands for any length."""
        return {
            "mean": (None, keypoints, 2),
            "basis": (None, keypoints, 2, None),
            "noise": (1,),
            "scales": (None, keypoints),
            "sides": (None,),
            "share": (1,),
        }

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
        same = len(mean) == len(basis) == len(scales) == len(sides)
        positive = noise > 0 and bool((scales > 0).all() and (sides > 0).all())
        if not same or not positive or not 0 < share < 1:
            raise WeightsError("the file contradicts itself about outliers")
        return cls(mean, basis, noise, scales, sides, share)


class OutlierJudge:
    """Judges frames of some views of a fit, each frame on its own."""

    def __init__(self, model: OutlierModel, views: Sequence[int]) -> None:
        chosen = list(views)
        self._model = model = model._replace(
            mean=model.mean[chosen],
            basis=model.basis[chosen],
            scales=model.scales[chosen],
            sides=model.sides[chosen],
        )
        # With little noise a prediction would follow outliers, so it begins with a lot.
        self._first = max(FIRST_NOISE * float(model.sides.mean()), model.noise)
        size = model.basis.shape[-1]
        flat = model.basis.reshape(model.mean.size, size)  # (D, Q)
        # Of frames that show everything: scores from offsets (D, Q), deviations of residuals (D,).
        self._predictions = []
        for noise in (self._first, model.noise):
            gains = np.linalg.solve(flat.T @ flat + noise**2 * np.eye(size), flat.T).T
            leverage = (flat * gains).sum(-1)
            deviations = _deviations(leverage, np.ones(len(flat), np.bool_))
            self._predictions.append((gains, deviations))

    def probabilities(self, observations: Observations) -> Float64:
        """Return how probably each keypoint (N, K, P) is an outlier.

        In a frame that is unlike those of the fit in all its keypoints, none is one.
        """
        pixels, observed = pixels_of(observations)
        result = np.zeros(observed.shape)

        def judge(part: slice) -> None:
            frames = np.flatnonzero(~self._clear(pixels[part], observed[part])) + part.start
            if len(frames):
                result[frames] = self._judge(pixels[frames], observed[frames])

        in_slices(len(pixels), FRAMES_AT_A_TIME, judge)
        return result

    def without_outliers(self, observations: Observations) -> Observations:
        """Return the observations less those that are probably outliers."""
        outliers = self.probabilities(observations) > 0.5
        if not outliers.any():
            return observations
        pixels, _ = pixels_of(observations)
        shown = np.where(outliers[..., None], np.nan, pixels)
        return as_observations(shown, observations.weights)

    def _clear(self, pixels: Float64, observed: Bool) -> Bool:
        """Tell which frames (N,) show everything, and nothing that could be an outlier."""
        clear = np.asarray(observed.all((1, 2)))
        if not clear.any():
            return clear
        offsets = (pixels - self._model.mean).reshape(len(pixels), -1)
        flat = self._model.basis.reshape(offsets.shape[1], -1)
        for gains, deviations in self._predictions:
            missed = (offsets - offsets @ gains @ flat.T) / deviations
            squared = np.square(missed).reshape(*observed.shape, 2).sum(-1)
            relative = squared / self._model.scales**2
            rows = (len(relative), -1)
            usual = _median(relative.reshape(rows), observed.reshape(rows)) / MEDIAN_OF_SQUARES
            clear &= (relative < self._least(usual.clip(1))).all((1, 2))
        return clear

    def _least(self, usual: Float64) -> Float64:
        """Return the squared errors from which keypoints are probably outliers (N, K, P).

        They are in units of the variances of inliers, as `usual` (N,) are those of the frames.
        """
        model = self._model
        variances = model.scales**2 * usual[:, None, None]
        odds = model.share / (1 - model.share) / model.sides[:, None] ** 2
        tails = (2 * np.pi * variances * odds) ** (-2 / (FREEDOM + 2)) - 1
        return np.asarray(FREEDOM * usual[:, None, None] * tails.clip(0))

    def _judge(self, pixels: Float64, observed: Bool) -> Float64:
        """Return the probabilities, predicting from what is no outlier."""
        model = self._model
        coarse = _outlying_given(model, self._first, pixels, observed, observed)
        result = _outlying_given(model, model.noise, pixels, observed, observed)
        doubtful = np.flatnonzero((np.maximum(result, coarse) > 0.5).any((1, 2)))
        if not len(doubtful):  # where all together look right, they are
            return result
        pixels, observed = pixels[doubtful], observed[doubtful]
        used = observed & ~_far(pixels, observed)
        for noise in np.geomspace(self._first, model.noise, JUDGING_ROUNDS):
            found = _outlying_given(model, noise, pixels, observed, used)
            used = observed & (found < 0.5)
        result[doubtful] = found
        return result


def learn_outliers(observations: Observations) -> OutlierModel | None:
    """Learn what keypoints are like that are no outliers; None if that cannot be told.

    That takes 40 frames, of 1200 coordinates at most.
    """
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
    sides = _sides(pixels, observed)
    used, share = observed & ~_far(pixels, observed), FIRST_SHARE
    given = np.where(observed[..., None], pixels, 0).reshape(len(frames), width)
    known = np.repeat(used.reshape(len(frames), -1), 2, axis=1)
    means = np.where(known, given, 0).sum(0) / known.sum(0).clip(1)
    filled = np.where(known, given, means)
    white = white_eigenvalues(len(frames), width)
    rank = min(len(frames) - 1, width)
    half = slice(rank // 2, rank)
    for _ in range(LEARNING_ROUNDS):
        for _ in range(FILLING_ROUNDS):
            mean = filled.mean(0)
            values, vectors = falling_eigenvalues(filled - mean)
            variance = max(values[half].mean() / white[half].mean(), 1e-12)
            kept = values > variance * (1 + np.sqrt(width / len(frames))) ** 2
            kept[MOST_COMPONENTS:] = False
            basis, gains = vectors[:, kept], 1 - variance / values[kept]
            predicted = mean + ((filled - mean) @ basis * gains) @ basis.T
            filled = np.where(known, given, predicted)
        leverage = np.square(basis) @ gains  # (D,)
        missed = (given - predicted) / _deviations(leverage, known)
        squared = np.square(missed).reshape(*observed.shape, 2).sum(-1)
        scales = _scales(squared, used, sides)
        outlying = _outlying(squared, observed, scales, sides, share)
        share = float((outlying.sum() / observed.sum()).clip(LEAST_SHARE, MOST_SHARE))
        used = observed & (outlying < 0.5)
        known = np.repeat(used.reshape(len(frames), -1), 2, axis=1)
    shape = (views, count, 2)
    spread = basis * np.sqrt(values[kept] - variance)
    return OutlierModel(
        mean.reshape(shape),
        spread.reshape(*shape, -1),
        float(np.sqrt(variance)),
        scales,
        sides,
        share,
    )


def _sides(pixels: Float64, observed: Bool) -> Float64:
    """Return the longer side of what every view (K,) shows of all frames."""
    low = np.where(observed[..., None], pixels, np.inf).min((0, 2))
    high = np.where(observed[..., None], pixels, -np.inf).max((0, 2))
    sides = (high - low).max(-1)
    return np.where(np.isfinite(sides), sides, 1.0).clip(1e-6)


def _far(pixels: Float64, observed: Bool) -> Bool:
    """Tell which keypoints lie far from the others of their view."""
    middle = _median(np.moveaxis(pixels, -1, -2), observed[:, :, None])  # (N, K, 2)
    distances = np.linalg.norm(pixels - middle[:, :, None], axis=-1)
    usual = _median(distances, observed)  # (N, K)
    return np.asarray(observed & (distances > FAR * usual[..., None]))


def _median(numbers: Float64, shown: Bool) -> Float64:
    """Return the lower median of what is shown along the last axis; 0 where nothing is.

    NumPy's median without NaN takes many times as long for one frame.
    """
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


def _outlying(
    squared: Float64, observed: Bool, scales: Float64, sides: Float64, share: float
) -> Float64:
    """Return how probably keypoints (N, K, P) are outliers, by their squared errors."""
    # In a frame that is unlike the others, all errors are larger.
    rows = (len(squared), -1)
    relative = (squared / scales**2).reshape(rows)
    usual = _median(relative, observed.reshape(rows)) / MEDIAN_OF_SQUARES  # (N,)
    spread = scales**2 * usual.clip(1)[:, None, None]
    inlying = (1 + squared / (FREEDOM * spread)) ** (-(FREEDOM + 2) / 2) / (2 * np.pi * spread)
    anywhere = share / sides[:, None] ** 2
    return np.where(observed, anywhere / (anywhere + (1 - share) * inlying), 0)


def _deviations(leverage: Float64, used: Bool) -> Float64:
    """Return the standard deviations of residuals, those of errors being 1.

    Parameters
    ----------
    leverage
        What the prediction of a coordinate changes by with the coordinate, were it used.
    used
        (N, D) whether it was.
    """
    return np.sqrt(np.where(used, 1 - leverage.clip(max=MOST_LEVERAGE), 1 + leverage.clip(max=1)))


def _outlying_given(
    model: OutlierModel, noise: float, pixels: Float64, observed: Bool, used: Bool
) -> Float64:
    """Judge keypoints (N, K, P) by a prediction from what is `used`, with so much noise."""
    frames, size = len(pixels), model.basis.shape[-1]
    flat = model.basis.reshape(model.mean.size, size)  # (D, Q)
    offsets = np.where(observed[..., None], pixels - model.mean, 0).reshape(frames, -1)
    shown = np.repeat(used.reshape(frames, -1), 2, axis=1).astype(np.float64)  # (N, D)
    if (shown == shown[:1]).all():  # then one matrix does for all frames
        inner = ((flat * shown[0][:, None]).T @ flat)[None]
    else:
        products = (flat[:, :, None] * flat[:, None]).reshape(len(flat), -1)  # (D, Q Q)
        inner = (shown @ products).reshape(-1, size, size)
    inner = inner + noise**2 * np.eye(size)
    inverse = np.linalg.inv(inner)
    scores = (inverse @ ((offsets * shown) @ flat)[..., None])[..., 0]  # (N, Q)
    leverage = ((flat @ inverse) * flat).sum(-1)  # (N, D)
    missed = (offsets - scores @ flat.T) / _deviations(leverage, shown > 0)
    squared = np.square(missed).reshape(*observed.shape, 2).sum(-1)
    return _outlying(squared, observed, model.scales, model.sides, model.share)
