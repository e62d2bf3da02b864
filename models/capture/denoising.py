"""Denoising before any geometry: all views of a frame together lie near a low-dimensional set.

Stack the keypoints of all views of a frame into one vector. Seen by static cameras, these vectors
have few principal components, while noise has as many as there are coordinates. Where the smaller
components of a capture look like white noise, probabilistic PCA (Tipping & Bishop, 1999) separates
signal from noise, and a mixture of Gaussians models the signal. Moving cameras raise the
dimension. The smaller components show this, and nothing is done then.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.capture.heavy_tails import clip_frames_into, learn_tails
from models.capture.observations import Observations, as_observations, pixels_of
from models.capture.principal_curves import (
    PrincipalCurves,
    expect_on_curves_into,
    learn_curves,
    no_curves,
)
from models.capture.score_mixture import (
    ScoreMixture,
    degrees_of_freedom,
    learn_mixture,
    posterior_means_into,
    standard_normal,
)
from models.numerics.eigenvalues import falling_eigenvalues, white_eigenvalues
from models.numerics.medians import MEDIAN_OF_SQUARES
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import in_slices
from models.settings.keypoints import MAX_COORDINATE

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

DENOISER_KIND = "curves"  # in files: a mixture and curves, noise of each keypoint in each view

# Figures: evidence/noise.md.
FRAMES_AT_A_TIME = 64  # that a thread denoises
LEAST_FRAMES = 40  # with fewer, noise and signal are hardly distinguishable
MOST_FRAMES = 4000  # plenty to learn components from
MOST_COORDINATES = 2000  # of a frame: the covariance has as many rows
OBSERVED_SHARE = 0.7  # of its coordinates that a frame must have to be learnt from
ROUNDS = 15  # of learning the noise of each keypoint, and filling what was not observed
LITTLE = 0.01  # change of a level of noise that is no change, as a share of it
FRAMES_PER_LEVEL = 2  # times as many as coordinates, to learn how unequal noise is
POOLED_FRAMES = 20  # that the noise of all keypoints together counts for in that of each
LEAST_VARIANCE = 1e-12  # pixels^2: of what does not move at all
MOST_UNEQUAL = 4.0  # times as much noise as in the median keypoint, or as little
# Noise is white if the eigenvalues between these places, as shares of all, fall no more than so
# many times as steeply as those of white noise.
TAIL_START, TAIL_END, MOST_STEEPNESS = 0.55, 0.95, 1.2
UNLIKE = 2.0  # standard errors by which a frame must lie further off than noise explains
LEAST_SHARE = 0.1  # of curves in what is expected: with less, they are not worth their time
LEAST_NOISE = 0.02  # of a view's size: with less noise than that, geometry does better alone


class Denoiser(NamedTuple):
    """y = mean + x + e with e ~ t(0, noise^2), of all views of a frame; pixels.

    What is expected of x is the mean of two answers: x = B z with z ~ mixture, and x ~ curves.
    """

    mean: Float64  # (K, P, 2)
    basis: Float64  # (K, P, 2, Q)
    noise: Float64  # (K, P) standard deviations
    tails: float  # one over the degrees of freedom of the noise; 0 if it is Gaussian
    mixture: ScoreMixture
    curves: PrincipalCurves

    @property
    def remaining_noise(self) -> float:
        """The noise that the mixture leaves in a coordinate, pixels; with curves it is less."""
        flat = self.basis.reshape(self.mean.size, -1)  # (D, Q)
        scaled = (self.basis / self.noise[..., None, None]).reshape(flat.shape)
        left = np.linalg.inv(self.mixture.precisions + scaled.T @ scaled)  # (M, Q, Q)
        size = (left * (flat.T @ flat)).sum((1, 2))  # (M,)
        determinants = np.linalg.slogdet(self.mixture.precisions).logabsdet
        shares = np.exp(self.mixture.heights - determinants / 2)
        return float(np.sqrt(size @ shares / shares.sum() / len(flat)))

    def denoise(self, observations: Observations, views: Sequence[int]) -> Observations:
        """Replace what was observed in `views` (of the fit) by its expectation."""
        mean, noise = self.mean[list(views)], self.noise[list(views)][..., None]
        pixels, observed = pixels_of(observations)
        rows = (len(pixels), mean.size)
        offsets = np.where(observed[..., None], (pixels - mean) / noise, 0).reshape(rows)  # (N, D)
        shown = np.repeat(observed.reshape(len(pixels), mean.size // 2), 2, axis=1)
        expected = np.empty_like(offsets)

        def denoise_part(part: slice) -> None:
            expected[part] = self._expected(offsets[part], shown[part], views)

        in_slices(len(pixels), FRAMES_AT_A_TIME, denoise_part)
        removed = pixels - mean - noise * expected.reshape(pixels.shape)
        unknown = _unknown_share(removed / noise, observed, heavy=self.tails > 0)
        kept = pixels - (1 - unknown) * removed
        return as_observations(np.where(observed[..., None], kept, np.nan), observations.weights)

    def _expected(self, offsets: Float64, shown: Bool, views: Sequence[int]) -> Float64:
        """Return the expected coordinates of frames (N, D) of which a part was observed.

        Both are less their mean, in standard deviations of the noise.
        """
        basis = self.basis[list(views)] / self.noise[list(views)][..., None, None]
        flat = basis.reshape(offsets.shape[1], -1)  # (D, Q)
        scores = np.empty((len(offsets), flat.shape[1]))
        posterior_means_into(self.mixture, flat, offsets, shown, self.tails, scores)
        expected: Float64 = scores @ flat.T
        if self.curves.share > 0:
            points = self.curves.points
            rows = np.arange(self.mean.size).reshape(len(self.mean), -1)[list(views)].ravel()
            on_curves = np.empty_like(offsets)
            expect_on_curves_into(
                points.reshape(self.mean.size, -1),
                self.curves.heights,
                rows,
                offsets,
                shown,
                self.tails,
                on_curves,
            )
            expected += self.curves.share * (on_curves - expected)
        return expected

    def to_arrays(self) -> Arrays:
        """Return the denoiser as tensors, for a file."""
        parts: dict[str, ArrayLike] = self._asdict() | self.mixture._asdict()
        del parts["mixture"], parts["curves"]
        curves = {f"curves_{name}": value for name, value in self.curves._asdict().items()}
        tensors = as_tensors(parts | curves)
        return tensors | {"curves_points": tensors["curves_points"].float()}

    @classmethod
    def shapes(cls, keypoints: int, kind: str) -> Shapes:
        """Shapes of what `to_arrays` returns, for P keypoints; None stands for any length.

        Older versions had a `kind` "levels", without curves, "mixture", with one noise for all
        keypoints, and before that no mixture but probabilistic PCA.
        """
        unequal = kind in (DENOISER_KIND, "levels")
        shapes: Shapes = {
            "mean": (None, keypoints, 2),
            "basis": (None, keypoints, 2, None),
            "noise": (None, keypoints) if unequal else (1,),
        }
        if kind == DENOISER_KIND:
            shapes |= {
                "curves_points": (None, keypoints, 2, None),
                "curves_heights": (None,),
                "curves_share": (1,),
            }
        if unequal:
            shapes["tails"] = (1,)
        if unequal or kind == "mixture":
            shapes |= {
                "heights": (None,),
                "centres": (None, None),
                "precisions": (None, None, None),
            }
        return shapes

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Denoiser":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        mean, basis = arrays["mean"].numpy(), arrays["basis"].numpy()
        noise, size = arrays["noise"].numpy(), basis.shape[-1]
        if noise.shape == (1,):
            noise = np.full(mean.shape[:2], noise.item())
        tails = arrays["tails"].item() if "tails" in arrays else 0.0
        mixture = standard_normal(size)
        if "heights" in arrays:
            mixture = ScoreMixture(*(arrays[name].numpy() for name in ScoreMixture._fields))
        count = len(mixture.heights)
        fits = (
            mixture.centres.shape == (count, size)
            and mixture.precisions.shape == (count, size, size)
            and count > 0
            and bool((np.linalg.eigvalsh(mixture.precisions) > 0).all())
        )
        fits = fits and len(mean) == len(basis) and noise.shape == mean.shape[:2]
        if not fits or not ((noise > 0) & (noise <= MAX_COORDINATE)).all() or not 0 <= tails < 1:
            raise WeightsError("the file contradicts itself about the noise")
        curves = no_curves(*noise.shape)
        if "curves_points" in arrays:
            points = np.ascontiguousarray(arrays["curves_points"].double().numpy())
            heights, share = arrays["curves_heights"].numpy(), arrays["curves_share"].item()
            curves = PrincipalCurves(points, heights, share)
        fits = curves.points.shape == (*mean.shape, len(curves.heights))
        if not fits or not 0 <= curves.share <= float(len(curves.heights) > 0):
            raise WeightsError("the file contradicts itself about the curves")
        return cls(mean, basis, noise, tails, mixture, curves)


def learn_denoiser(observations: Observations) -> Denoiser | None:
    """Learn a denoiser from a capture; None if it would not help.

    Coordinates are divided by the noise of their keypoint. Their eigenvalues are then compared
    with those of white noise, a Gaussian matrix of the same shape, which gives the variance of the
    noise and the number of components. The noise of each keypoint and view is the variance that
    the components do not explain (factor analysis by expectation maximisation: Rubin and Thayer,
    1982).
    """
    keypoints, observed = pixels_of(observations)
    usable = observations.usable
    size = float(np.median(observations.sizes[usable])) if usable.any() else 1.0
    views, count = keypoints.shape[1:3]
    frames = np.flatnonzero(observed.sum((1, 2)) >= OBSERVED_SHARE * observed.any(0).sum())
    # Draws go by places, so frames get places that do not depend on their order.
    frames = frames[np.nansum(keypoints[frames], axis=(1, 2, 3)).argsort(kind="stable")]
    frames = frames[:: max(1, -(-len(frames) // MOST_FRAMES))]
    width = 2 * views * count  # D
    if len(frames) < LEAST_FRAMES or width > MOST_COORDINATES:
        return None
    known = np.repeat(observed[frames].reshape(len(frames), -1), 2, axis=1)  # (N, D)
    given = np.where(known, keypoints[frames].reshape(len(frames), -1), 0)
    found = _find_components(given, known, alike=True)
    if not found.white and len(frames) >= FRAMES_PER_LEVEL * width:
        found = _find_components(given, known, alike=False)
    if not found.white or found.variance <= 0:
        return None
    noise = np.sqrt(found.variance) * found.levels
    errors = found.errors[known[:, ::2]] / found.variance
    level = np.sqrt(np.square(noise).mean())
    weights = observations.weights[frames].reshape(-1)[known[:, ::2].ravel()]
    if not found.alike and np.ptp(weights) > 0:
        # Confidences let geometry take little notice of the worst keypoints, and the more views
        # it has, the less. Noise is removed without regard to them.
        level = np.median(noise) * np.sqrt(np.median(errors) / MEDIAN_OF_SQUARES * 3 / (2 * views))
    if level < LEAST_NOISE * size or not found.basis.size:
        return None
    white = float(np.sqrt(found.variance))
    denoiser = Denoiser(
        (found.mean * found.levels).reshape(views, count, 2),
        (found.basis * found.levels[:, None]).reshape(views, count, 2, -1),
        noise.reshape(views, count, 2)[..., 0],
        learn_tails(errors),
        learn_mixture(found.scores, white),
        no_curves(views, count),
    )
    freedom = degrees_of_freedom(denoiser.mixture, found.scores, white)
    offsets = np.where(known, (given - found.mean * found.levels) / noise, 0)
    return denoiser._replace(curves=_learn_curves(denoiser, offsets, known, freedom))


def _learn_curves(
    mixture: Denoiser, offsets: Float64, known: Bool, freedom: float
) -> PrincipalCurves:
    """Learn curves from frames (N, D), partly observed, that a mixture denoises already.

    The curves' share in the answer minimises Stein's unbiased estimate of the risk (1981): the
    squared residuals plus twice the degrees of freedom. `freedom` are those of the mixture.
    """
    views, count, _ = mixture.mean.shape
    by_mixture = mixture._expected(offsets, known, range(views))
    clipped = np.empty_like(offsets)
    clip_frames_into(offsets, by_mixture, mixture.tails, clipped)
    filled = np.where(known, clipped, by_mixture)
    learnt = learn_curves(filled, by_mixture, mixture.basis.shape[-1])
    if learnt is None:
        return no_curves(views, count)
    change = (learnt.expected - by_mixture)[known]
    kept = (learnt.freedom - freedom) / filled.shape[1]
    gained = ((filled - by_mixture)[known] * change).mean() - kept
    share = float(min(gained / np.square(change).mean(), 1.0))
    if not share > LEAST_SHARE:
        return no_curves(views, count)
    # As precise as in a file, so that it makes no difference whether a model was stored.
    points = learnt.points.T.astype(np.float32).astype(np.float64)
    return PrincipalCurves(
        np.ascontiguousarray(points).reshape(views, count, 2, -1), learnt.heights, share
    )


class _Components(NamedTuple):
    """Principal components of coordinates (D) that were divided by their levels of noise."""

    levels: Float64  # (D,) pixels, alike for both coordinates of a keypoint
    mean: Float64  # (D,)
    basis: Float64  # (D, Q) the components that stand out of the noise
    variance: float  # of the noise
    alike: bool  # whether all levels are one
    white: bool  # whether the noise is
    scores: Float64  # (N, Q)
    errors: Float64  # (N, D / 2) squares of what they leave of keypoints


def _find_components(given: Float64, known: Bool, *, alike: bool) -> _Components:
    """Find the components of coordinates (N, D) of which some are known, and their levels.

    Levels are all one if they are `alike`.
    """
    frames, width = given.shape
    shown = int(known.any(0).sum())  # coordinates that are never known do not vary
    white = white_eigenvalues(frames, shown)
    rank = min(frames - 1, shown)
    half, start, end = slice(rank // 2, rank), int(TAIL_START * rank), int(TAIL_END * rank)
    times = known.sum(0)
    filled, levels = np.where(known, given, given.sum(0) / times.clip(1)), np.ones(width)
    if not alike:
        # The noise of a coordinate starts as its variance given all others. Without this start, a
        # very noisy coordinate would get a component to itself.
        values, vectors = falling_eigenvalues(filled - filled.mean(0))
        unexplained = 1 / (np.square(vectors) / (values + values[half].mean())).sum(1)
        levels = _changes_of_levels(unexplained, times)
    for _ in range(1 if alike and known.all() else ROUNDS):
        scaled = filled / levels
        mean = scaled.mean(0)
        values, vectors = falling_eigenvalues(scaled - mean)
        variance = values[half].mean() / white[half].mean()
        kept = values > variance * (1 + np.sqrt(shown / frames)) ** 2
        basis, share = vectors[:, kept], np.clip(1 - variance / values[kept], 0, None)
        scores = (scaled - mean) @ basis
        expected = mean + (scores * share) @ basis.T
        is_white = values[start] * white[end] <= MOST_STEEPNESS * values[end] * white[start]
        squares = np.where(known, np.square(scaled - expected), 0)
        errors = squares.reshape(frames, -1, 2).sum(-1)
        found = _Components(
            levels, mean, basis, float(variance), alike, bool(is_white), scores, errors
        )
        filled = np.where(known, given, expected * levels)
        if alike:
            continue
        # Of known coordinates: the residual, and the variance of the expectation.
        unsure = variance * (np.square(basis) * share).sum(1)
        levels = levels * _changes_of_levels(squares.sum(0) / times.clip(1) + unsure, times)
        middle = np.median(levels)
        levels = levels.clip(middle / MOST_UNEQUAL, middle * MOST_UNEQUAL)
        if known.all() and np.abs(levels / found.levels - 1).max() < LITTLE:
            break
    return found


def _changes_of_levels(variances: Float64, times: Int64) -> Float64:
    """Return the factors (D,) by which the noise of keypoints exceeds the usual one.

    `variances` (D,) are those of the coordinates, each measured `times` (D,) times.
    """
    variances, times = variances.reshape(-1, 2).mean(1), times[::2]
    usual = max(float(np.median(variances)), LEAST_VARIANCE)
    pooled = (variances * times + usual * POOLED_FRAMES) / (times + POOLED_FRAMES)
    return np.sqrt(pooled / usual).repeat(2)


def _unknown_share(removed: Float64, observed: Bool, *, heavy: bool) -> Float64:
    """Return the share (N, 1, 1, 1) of `removed` (N, K, P, 2) that is signal rather than noise.

    `removed` is in standard deviations of the noise. A frame unlike those of the fit lies further
    from its expectation than noise explains. The excess is signal that the mixture does not know;
    it is 0 where noise explains everything. If tails are `heavy` and one view alone has a keypoint
    far off, that view is wrong, so its error is replaced by that of the next worst view. The
    others lose no information (spacings of exponential variables are independent).
    """
    squares = np.where(observed, np.square(removed).sum(-1), 0)  # (N, K, P)
    shown = observed.sum(1)  # (N, P)
    summed = squares.sum(1)
    if heavy:
        worst = np.sort(squares, axis=1)[:, -2:]
        summed = np.where(shown > 1, summed - worst[:, -1] + worst[:, 0], summed)
        shown = np.where(shown > 1, shown - 1, shown)
    count = 2 * shown.sum(1).clip(1)  # (N,)
    variances = summed.sum(1) / count
    unlike = variances > 1 + UNLIKE * np.sqrt(2 / count)
    unknown = np.where(unlike, variances - 1, 0)
    share: Float64 = unknown / (1 + unknown)
    return share.reshape(-1, 1, 1, 1)
