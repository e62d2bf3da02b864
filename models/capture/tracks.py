"""Keypoints as functions of time: positions and velocities between frames, by local regression.

Around a time, a parabola is fitted to the keypoint's pixels in the frames near by (local quadratic
regression; Fan & Gijbels, *Local Polynomial Modelling and Its Applications*, 1996), which smooths
and bridges short gaps. Nothing is fitted across a cut, where one film ends and another begins.
Times are counted in frames of the view itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

# Half widths in frames that are tried: the least one uses four frames, the widest about fifty.
HALF_WIDTHS = (2.5, 4.5, 7.5, 12.5, 20.5)
LEAST_FRAMES = 3  # in which a keypoint must be seen for a parabola through them
WIDTH_FRAMES = 400  # enough to choose a width from
CUT = 5.0  # a jump is a cut if keypoints move this much farther than between the frames around it
CUT_NEIGHBOURS = 3  # frames on either side that a jump is compared with
MEDIAN_FRAMES = 9  # around a frame, whose median outliers hardly move
STRAY = 6.0  # times the usual distance from that median: an outlier
OUTLIER = 5.0  # times the median: how much one residual may count when widths are compared
TINY = 1e-9


class Motion(NamedTuple):
    """Where keypoints are at given times, and how fast; NaN where too few frames show them."""

    places: Float64  # (T, P, 2) pixels
    velocities: Float64  # (T, P, 2) pixels per frame


class Track(NamedTuple):
    """The keypoints of one view over its N frames."""

    pixels: Float64  # (N, P, 2), anything where not observed
    weights: Float64  # (N, P), 0 where not observed
    clips: NDArray[np.int64]  # (N,) which clip a frame belongs to; clips are parted by cuts


def make_track(pixels: Float64, weights: Float64) -> Track:
    """Return the track of a view's keypoints (N, P, 2) of weights (N, P).

    Its cuts are found, and what lies far from the keypoint's median over the frames around it
    counts as not observed.
    """
    kept = weights * ~_strays(pixels, weights)
    return Track(pixels, kept, number_clips(pixels, kept))


def motion_at(track: Track, times: Float64, half_width: float) -> Motion:
    """Fit parabolas to the frames within `half_width` of `times` (T,), in frames; NaN: no time."""
    moments, products = _sums(track, times, half_width)
    (s0, s1, s2, s3, s4), (t0, t1, t2) = moments, products
    # Cramer's rule for the 3 x 3 normal equations of value, slope and curvature.
    c00, c01, c02 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    c11, c12 = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(determinant > TINY, 1 / determinant, np.nan)[..., None]
        places = (c00[..., None] * t0 + c01[..., None] * t1 + c02[..., None] * t2) * scale
        slopes = (c01[..., None] * t0 + c11[..., None] * t1 + c12[..., None] * t2) * scale
    return Motion(places, slopes)


def choose_half_width(
    tracks: list[Track], half_widths: Sequence[float] = HALF_WIDTHS
) -> float | None:
    """Return the half width that predicts every keypoint best from the frames around it.

    None without any to choose from.

    Leave-one-out cross-validation of local regression: wide where noise is high, narrow where
    keypoints are clear.
    """
    if not half_widths:
        return None
    frames = len(tracks[0].pixels)
    start = max(0, (frames - WIDTH_FRAMES) // 2)
    chosen = slice(start, start + WIDTH_FRAMES)
    parts = [Track(t.pixels[chosen], t.weights[chosen], t.clips[chosen]) for t in tracks]
    errors = []
    for half_width in half_widths:
        left_out = [np.linalg.norm(_residuals_left_out(p, half_width), axis=-1) for p in parts]
        errors.append(np.stack(left_out))
    together = np.isfinite(np.stack(errors)).all(0)  # compared where all widths give an error
    if not together.any():
        return half_widths[0]
    limit = OUTLIER * np.median(np.stack(errors)[:, together], 1).min()
    means = [np.minimum(error[together], limit).mean() for error in errors]
    return half_widths[int(np.argmin(means))]


def _sums(
    track: Track, times: Float64, half_width: float
) -> tuple[tuple[Float64, ...], tuple[Float64, ...]]:
    """Sum weight x offset^0..4 (T, P), and weight x offset^0..2 x pixels (T, P, 2)."""
    frames, keypoints, _ = track.pixels.shape
    known = np.isfinite(times)
    base = np.where(known, np.round(times), -1).astype(np.int64)
    fraction = np.where(known, times - base, 0.0)  # (T,) the base frame is this much earlier
    inside = (base >= 0) & (base < frames)
    home = track.clips[np.clip(base, 0, frames - 1)]
    moments = np.zeros((5, len(times), keypoints))
    products = np.zeros((3, len(times), keypoints, 2))
    count = np.zeros((2, len(times), keypoints))  # frames seen at or before the time, and after
    reach = int(np.ceil(half_width))
    for step in range(-reach, reach + 1):
        index = np.clip(base + step, 0, frames - 1)
        offset = step - fraction
        kernel = np.maximum(1 - (offset / half_width) ** 2, 0.0)
        kernel *= inside & (base + step == index) & (track.clips[index] == home)
        weights = kernel[:, None] * track.weights[index]
        seen = weights > 0
        count[0] += seen & (offset <= 0.5)[:, None]
        count[1] += seen & (offset >= -0.5)[:, None]
        pixels = track.pixels[index]
        for power in range(5):
            moments[power] += weights
            if power < 3:
                products[power] += weights[..., None] * pixels
            weights = weights * offset[:, None]
    # Parabolas are not continued beyond the frames they were fitted to.
    enough = (count.min(0) > 0) & (count.sum(0) > LEAST_FRAMES)
    moments[0][~enough] = 0.0
    return tuple(moments * enough), tuple(products)


def _residuals_left_out(track: Track, half_width: float) -> Float64:
    """Observed minus predicted from the other frames (N, P, 2); NaN where that is not possible."""
    frames = len(track.pixels)
    moments, products = _sums(track, np.arange(frames, dtype=np.float64), half_width)
    own = track.weights  # the kernel is 1 at its centre
    seen = own > 0
    without = np.maximum(moments[0] - own, 0), *moments[1:]
    s0, s1, s2, s3, s4 = without
    c00, c01, c02 = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    t0 = products[0] - own[..., None] * np.where(seen[..., None], track.pixels, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(seen & (determinant > TINY), 1 / determinant, np.nan)[..., None]
        places = c00[..., None] * t0 + c01[..., None] * products[1] + c02[..., None] * products[2]
        residuals: Float64 = track.pixels - places * scale
    return residuals


def _strays(pixels: Float64, weights: Float64) -> NDArray[np.bool_]:
    """Return which keypoints (N, P) lie far from their median in the frames around."""
    if len(pixels) < MEDIAN_FRAMES:
        return np.zeros(weights.shape, bool)
    observed = np.where((weights > 0)[..., None], pixels, np.nan)
    with np.errstate(invalid="ignore"):
        away = np.linalg.norm(observed - _running_median(observed), axis=-1)  # (N, P)
        if not np.isfinite(away).any():
            return np.zeros(weights.shape, bool)
        usual = np.fmax(_running_median(away), np.nanmedian(away))
        strays: NDArray[np.bool_] = away > STRAY * usual
    return strays


def _running_median(values: Float64) -> Float64:
    """Median over `MEDIAN_FRAMES` frames around each, of what is not NaN, along the first axis."""
    reach = MEDIAN_FRAMES // 2
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="reflect")
    return masked_median(np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_FRAMES, axis=0))


def number_clips(pixels: Float64, weights: Float64) -> NDArray[np.int64]:
    """Return the clip number of each frame (N,): keypoints jump from one clip to the next."""
    cuts = np.zeros(len(pixels), bool)
    cuts[1:] = cuts_among(jumps_between(pixels, weights))
    return np.cumsum(cuts)


def jumps_between(pixels: Float64, weights: Float64) -> Float64:
    """Return how far keypoints (N, ..., P, 2) move from frame to frame, (N-1, ...), by median.

    NaN where no keypoint is seen in both of two frames.
    """
    both = (weights[1:] > 0) & (weights[:-1] > 0)
    return masked_median(np.where(both, np.linalg.norm(np.diff(pixels, axis=0), axis=-1), np.nan))


def cuts_among(jumps: Float64) -> NDArray[np.bool_]:
    """Return which of the jumps (N-1, ...) from frame to frame are cuts.

    A jump is compared with those before and after it, at the end with those before it alone.
    """
    known = np.nan_to_num(jumps)
    if len(jumps) <= 2 * CUT_NEIGHBOURS or known.max() <= CUT * known.min():
        return np.zeros(jumps.shape, bool)
    reach = [(CUT_NEIGHBOURS, CUT_NEIGHBOURS)] + [(0, 0)] * (jumps.ndim - 1)
    padded = np.pad(known, reach, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * CUT_NEIGHBOURS + 1, axis=0)
    others = np.delete(around, CUT_NEIGHBOURS, axis=-1).max(-1)
    return np.asarray(jumps > CUT * np.maximum(others, TINY))


def masked_median(values: Float64) -> Float64:
    """Median over the last axis of what is not NaN (the upper of two middle ones); NaN if none."""
    count = np.isfinite(values).sum(-1)
    ordered = np.sort(values, axis=-1)  # NaN come last
    middle = np.minimum(count // 2, values.shape[-1] - 1)
    return np.asarray(np.take_along_axis(ordered, middle[..., None], -1)[..., 0], np.float64)
