"""How keypoints move: noise removed by what the frames before and after show.

All views of a frame, stacked into one vector, are modelled as an integrated Wiener process under
white noise: velocities change at random, with a covariance between all keypoints and views. This
covariance and the noise of every view and keypoint are learnt by expectation maximisation (Shumway
& Stoffer, 1982). Whitened by the noise, in the basis in which the covariance is diagonal, the
coordinates are independent, and each is smoothed separately. Cameras may be static or moving.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import Observations, as_observations, pixels_of
from models.capture.tracks import number_clips
from models.numerics.eigenvalues import falling_eigenvalues, white_eigenvalues
from models.numerics.kalman import smooth, summed_products
from models.numerics.medians import NORMAL
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

# Figures: evidence/noise.md.
LEAST_FRAMES = 40  # with fewer, noise and motion are hardly distinguishable
MOST_COORDINATES = 800  # of a frame: the covariance has as many rows
# What is learnt from: blocks of frames, as many as take seconds.
MOST_FRAMES, MOST_PRODUCTS, BLOCK = 4000, 400_000_000, 200
OBSERVED_SHARE = 0.7  # of its coordinates that a frame must have to be learnt from
ROUNDS = 60
FASTER = 1.8  # times the change that expectation maximisation makes to the covariance, per round
PLENTY = 0.3  # coordinates for each frame; with fewer, correlations are well determined
POOLED_FRAMES = 5  # that the noise of all keypoints counts for in that of each
LEAST_RATE = 1e-7  # of the noise's variance, in any direction
LEAST_CLIP = 10  # frames that are smoothed with each other
LONGEST_STEP = 10.0  # usual steps: a longer pause parts two clips
MOST_LEFT = 0.7  # of the noise: where more is left, frames are too far apart to predict each other
MOST_PEAK = 1.5  # times the largest eigenvalue of white noise that what is removed may have
LEAST_NOISE = 0.01  # of a view's size: with less noise than that, geometry does better alone
MOSTLY = 0.95  # of the frames it must follow, or there are jumps and cuts that were not given
# Within so many frames of one, the mean square of what is removed from a keypoint, in variances.
REACH, MOST_SQUARES = 5, 2.5
FILLING_ROUNDS, FILLED = 30, 0.02  # of filling what was not observed; no change, in noise
FIRST_RATES = np.logspace(-6, 3, 28)  # that are tried to begin with, in variances of the noise
FRAMES_AT_A_TIME, MARGIN = 2000, 200  # smoothed together, and beside these


class MotionModel(NamedTuple):
    """dx = v dt, dv ~ N(0, covariance dt), y = x + e, of all views of a frame; pixels."""

    covariance: Float64  # (D, D) of the change of velocities in a step, D = 2 K P
    noise: Float64  # (K, P) standard deviation of e in a coordinate
    step: float  # seconds: the usual time between frames
    left: float  # pixels of noise in a coordinate after smoothing, as far as the model knows

    def smooth(
        self, observations: Observations, times: Float64, views: Sequence[int]
    ) -> tuple[Observations, Bool]:
        """Smooth the keypoints that were observed in `views` (of the fit).

        `times` (N,) are in seconds, rising. A frame stays as it is if it has too few neighbours or
        if its keypoints move as they never did in the fit. The second result (N,) states which
        frames were smoothed.
        """
        pixels, observed = pixels_of(observations)
        noise = np.repeat(self.noise[list(views)].reshape(-1), 2)  # (D,)
        basis, rates = falling_apart(self.covariance_of(views), noise)
        steps = _steps(pixels, observed, times, self.step)
        clips = np.cumsum(steps == 0)
        enough = (np.bincount(clips) >= LEAST_CLIP)[clips]  # (N,)
        smoothed = np.empty_like(pixels)
        for begin in range(0, len(pixels), FRAMES_AT_A_TIME):
            end = begin + FRAMES_AT_A_TIME
            around = with_neighbours(slice(begin, end))
            part = bridged(pixels[around], observed[around]) / noise
            shown = np.repeat(observed[around].reshape(len(part), -1), 2, axis=1)
            now = steps[around].copy()
            now[0] = 0.0
            given, there = part.copy(), np.any(shown, axis=1)
            for _ in range(1 if shown.all() else FILLING_ROUNDS):
                before = part
                filled = np.where(shown, given, part)
                part = (basis @ smooth((filled @ basis).T, now, there, rates, 1.0).values).T
                if np.abs(part - before)[~shown].max(initial=0.0) < FILLED:
                    break
            own = slice(begin - around.start, end - around.start)
            smoothed[begin:end] = (part[own] * noise).reshape(smoothed[begin:end].shape)
        removed = np.where(observed[..., None], pixels - smoothed, 0)
        enough &= explained(removed / noise.reshape(pixels.shape[1:]), observed)
        smoothed = np.where(enough[:, None, None, None], smoothed, pixels)
        shown = np.where(observed[..., None], smoothed, np.nan)
        return as_observations(shown, observations.weights), enough

    def covariance_of(self, views: Sequence[int]) -> Float64:
        """Return the covariance of the velocities in some of the views."""
        size = self.covariance.shape[0] // len(self.noise)
        chosen = np.concatenate([np.arange(size) + view * size for view in views])
        return np.asarray(self.covariance[np.ix_(chosen, chosen)])

    def to_arrays(self) -> Arrays:
        """Return the model as tensors, for a file."""
        return as_tensors(self._asdict())

    @classmethod
    def shapes(cls, keypoints: int) -> Shapes:
        """Shapes of what `to_arrays` returns, for P keypoints; None stands for any length."""
        return {"covariance": (None, None), "noise": (None, keypoints), "step": (1,), "left": (1,)}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "MotionModel":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        covariance, noise = arrays["covariance"].numpy(), arrays["noise"].numpy()
        size, step, left = 2 * noise.size, arrays["step"].item(), arrays["left"].item()
        fits = covariance.shape == (size, size) and bool((covariance == covariance.T).all())
        if not fits or not (noise > 0).all() or not step > 0 or not left > 0:
            raise WeightsError("the file contradicts itself about how keypoints move")
        return cls(covariance, noise, step, left)


def with_neighbours(frames: slice) -> slice:
    """Return these frames and the neighbours that are smoothed together with them."""
    return slice(max(frames.start - MARGIN, 0), frames.stop + MARGIN)


def learn_motion(observations: Observations, times: Float64) -> MotionModel | None:
    """Learn a motion model from a capture with `times` (N,) in seconds, rising.

    None if smoothing with it would not help.
    """
    pixels, observed = pixels_of(observations)
    frames, views, count = observed.shape
    width = 2 * views * count  # D
    if frames < LEAST_FRAMES or width > MOST_COORDINATES:
        return None
    step = float(np.median(np.diff(times)))
    steps = _steps(pixels, observed, times, step)
    clips, moments = np.cumsum(steps == 0), np.cumsum(steps)
    chosen = np.flatnonzero(observed.sum((1, 2)) >= OBSERVED_SHARE * observed.any(0).sum())
    chosen = chosen[_blocks(len(chosen), min(MOST_FRAMES, MOST_PRODUCTS // width**2))]
    if len(chosen) < LEAST_FRAMES:
        return None
    steps = np.diff(moments[chosen], prepend=moments[chosen[0]])
    steps[(np.diff(clips[chosen], prepend=-1) != 0) | (steps > LONGEST_STEP)] = 0.0
    if np.count_nonzero((steps[1:-1] > 0) & (steps[2:] > 0)) < LEAST_FRAMES:
        return None  # hardly a frame has both neighbours
    seen = observed[chosen]
    shown = np.repeat(seen.reshape(len(chosen), -1), 2, axis=1)  # (N, D)
    given = bridged(pixels[chosen], seen)
    there = np.any(shown, axis=1)
    covariance, noise = _first_guess(given, steps, there)
    part, changes = given.copy(), 2 * np.count_nonzero(steps)
    for _ in range(ROUNDS):
        basis, rates = falling_apart(covariance, noise)
        scores = (np.where(shown, given, part) / noise) @ basis
        smoothed = smooth(scores.T, steps, there, rates, 1.0)
        part = (smoothed.values.T @ basis.T) * noise
        learnt = np.outer(rates, rates) * summed_products(smoothed, steps)
        learnt = (learnt + np.diag(smoothed.doubts.sum(1))) / changes
        learnt += (FASTER - 1) * (learnt - np.diag(rates))
        left = np.square(basis) @ smoothed.variances.mean(1) * noise**2  # (D,)
        covariance = (noise[:, None] * basis) @ learnt @ (noise[:, None] * basis).T
        covariance = _shrunk((covariance + covariance.T) / 2, len(chosen))
        noise = _noise(np.where(shown, given - part, 0), shown, left, count)
    white = np.where(shown, (given - part) / noise, 0.0)
    follows = explained(white.reshape(*seen.shape, 2), seen)
    levels = float(np.sqrt(np.square(noise).mean())), float(np.sqrt(left.mean()))
    if not _is_noise(white) or levels[1] > MOST_LEFT * levels[0] or follows.mean() < MOSTLY:
        return None
    if levels[0] < LEAST_NOISE * float(np.median(observations.sizes[observations.usable])):
        return None
    return MotionModel(covariance, noise[::2].reshape(views, count), step, levels[1])


def _is_noise(residuals: Float64) -> bool:
    """Whether the part removed (N, D), in standard deviations, is noise and no motion.

    Motion that is too fast for the frames looks white in time, but moves many keypoints together.
    """
    return bool(
        falling_eigenvalues(residuals)[0][0] < MOST_PEAK * white_eigenvalues(*residuals.shape)[0]
    )


def explained(residuals: Float64, observed: Bool) -> Bool:
    """Return for each frame (N,) whether its residuals, in standard deviations, can be noise.

    Where a keypoint moves as it never did in the fit, the process does not follow it.
    """
    squares = _around(np.square(residuals).sum((1, 3)))  # (N, P)
    allowed = MOST_SQUARES * 2 * _around(observed.sum(1).astype(np.float64))
    return np.asarray((squares <= allowed).all(1))


def _around(numbers: Float64) -> Float64:
    """Sum numbers (N, P) over the frames within `REACH` of each."""
    sums = np.concatenate((np.zeros((1, numbers.shape[1])), np.cumsum(numbers, axis=0)))
    frames = np.arange(len(numbers))
    around: Float64 = sums[np.minimum(frames + REACH + 1, len(frames))]
    return around - sums[np.maximum(frames - REACH, 0)]


def falling_apart(covariance: Float64, noise: Float64) -> tuple[Float64, Float64]:
    """Return a basis (D, D) of the whitened coordinates, and the rates (D,) along it."""
    values, basis = np.linalg.eigh(covariance / np.outer(noise, noise))
    return basis, values.clip(LEAST_RATE)


def _shrunk(covariance: Float64, frames: int) -> Float64:
    """Shrink a covariance (D, D) from few frames towards its diagonal."""
    width = len(covariance)
    pooled = width * max(0.0, width / frames - PLENTY)
    diagonal = np.diag(np.diag(covariance))
    shrunk: Float64 = (frames * covariance + pooled * diagonal) / (frames + pooled)
    return shrunk


def _first_guess(given: Float64, steps: Float64, there: Bool) -> tuple[Float64, Float64]:
    """Guess covariance and noise (D,): principal components move independently of each other."""
    follows = (steps[2:] > 0) & (steps[1:-1] > 0)
    bends = np.diff(given, 2, axis=0)[follows]
    noise = float(np.sqrt(max(NORMAL**2 * np.median(np.square(bends)) / 6, TINY)))
    offsets = given - given.mean(0)
    _, basis = np.linalg.eigh(offsets.T @ offsets)
    scores = np.ascontiguousarray((offsets @ basis).T) / noise
    likelihoods = [
        smooth(scores, steps, there, np.full(len(scores), rate), 1.0).likelihoods
        for rate in FIRST_RATES
    ]
    rates = FIRST_RATES[np.argmax(likelihoods, axis=0)] * noise**2
    return _shrunk((basis * rates) @ basis.T, given.shape[0]), np.full(len(rates), noise)


def _noise(residuals: Float64, shown: Bool, left: Float64, keypoints: int) -> Float64:
    """Return the noise (D,) of coordinates, equal for both of a keypoint.

    It is estimated from the residuals (N, D) where observed, plus the smoothed variance `left`.
    """
    squares, frames = np.square(residuals).sum(0), shown.sum(0)
    both = (squares + left * frames).reshape(-1, 2).sum(1)
    every = both.sum() / frames.sum()
    of_each = (both + POOLED_FRAMES * 2 * every) / (frames[::2] + POOLED_FRAMES) / 2
    return np.repeat(np.sqrt(of_each.clip(TINY)), 2)


def _blocks(frames: int, most: int) -> Int64:
    """Return `most` frames at most, in blocks that are spread over the capture."""
    if frames <= most:
        return np.arange(frames)
    count = max(most // BLOCK, 1)
    starts = np.linspace(0, frames - BLOCK, count).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(min(BLOCK, most)))


def _steps(pixels: Float64, observed: Bool, times: Float64, step: float) -> Float64:
    """Return the time (N,) since the frame before, in usual steps; 0 where a clip begins."""
    steps = np.diff(times, prepend=times[0]) / step
    steps[steps > LONGEST_STEP] = 0.0
    for view in range(pixels.shape[1]):
        clips = number_clips(pixels[:, view], observed[:, view].astype(np.float64))
        steps[np.diff(clips, prepend=0) > 0] = 0.0
    return steps


def bridged(pixels: Float64, observed: Bool) -> Float64:
    """Return coordinates (N, D), straight from frame to frame where they were not observed."""
    frames, filled = np.arange(len(pixels)), pixels.copy()
    for k, p in np.argwhere(~observed.all(0)):
        there = np.flatnonzero(observed[:, k, p])
        for axis in range(2):
            known = pixels[there, k, p, axis] if len(there) else np.zeros(1)
            filled[:, k, p, axis] = np.interp(frames, there if len(there) else [0], known)
    return filled.reshape(len(pixels), -1)
