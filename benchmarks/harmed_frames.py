"""Frames that are harmed after the fit, and whether `quality` points at those that went wrong."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.drawn_captures import radius
from models.capture.metrics import procrustes_by_size
from models.lifting.fitted_prior import FittedPrior

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]
Rng = np.random.Generator
# Changes a run of frames of keypoints (N, K, P, 2) in place.
Harm = Callable[[Float64, slice, Rng], None]

RUN = 0.05  # of the frames, for each harm
WORST = 0.1  # of the frames, by error, that a low quality is to point at
SHIFT = 0.25  # of the subject's root-mean-square radius in the image and more
HIDDEN = 0.75  # of the keypoints


def views_swapped(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Exchange two views."""
    a, b = rng.choice(keypoints.shape[1], 2, replace=False)
    keypoints[run, a], keypoints[run, b] = keypoints[run, b].copy(), keypoints[run, a].copy()


def view_shifted(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Shift what a view shows, as if its camera had been turned."""
    view = int(rng.integers(keypoints.shape[1]))
    way = rng.standard_normal(2)
    far = rng.uniform(SHIFT, 4 * SHIFT) * radius(keypoints[:, view])
    keypoints[run, view] += far * way / np.linalg.norm(way)


def out_of_step(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Let a view show other frames, a quarter to a half of the capture away."""
    count, view = len(keypoints), int(rng.integers(keypoints.shape[1]))
    late = int(rng.uniform(count / 4, count / 2))
    keypoints[run, view] = keypoints[(np.arange(count)[run] + late) % count, view]


def keypoints_permuted(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Take keypoints for others, in all views alike, as of another skeleton."""
    keypoints[run] = keypoints[run][:, :, rng.permutation(keypoints.shape[2])]


def keypoints_hidden(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Hide most keypoints, drawn for each view and frame."""
    part = keypoints[run]
    part[rng.random(part.shape[:3]) < HIDDEN] = np.nan


def views_hidden(keypoints: Float64, run: slice, rng: Rng) -> None:
    """Hide all views but one."""
    hidden = np.arange(keypoints.shape[1]) != rng.integers(keypoints.shape[1])
    keypoints[run, hidden] = np.nan


HARMS: tuple[Harm, ...] = (
    views_swapped,
    view_shifted,
    out_of_step,
    keypoints_permuted,
    keypoints_hidden,
    views_hidden,
)


def harmed(keypoints: Float64, rng: Rng) -> Float64:
    """Return keypoints (N, K, P, 2) with a run of frames for each harm; no frame has two."""
    spoilt = keypoints.copy()
    length = max(2, round(RUN * len(keypoints)))
    starts = rng.permutation(len(keypoints) // length)[: len(HARMS)] * length
    for harm, start in zip(HARMS, starts, strict=False):
        harm(spoilt, slice(int(start), int(start) + length), rng)
    return spoilt


def area_for_worst(prior: FittedPrior, keypoints: Float64, truth: Float64, rng: Rng) -> float:
    """Return the area under the ROC curve of `quality` for the worst tenth of harmed frames.

    Frames without a structure have no error, and are left out. NaN if too few frames have one.
    """
    lift = prior.lift(harmed(keypoints, rng))
    errors = errors_of(lift.points3d.astype(np.float64), truth)
    known: Bool = np.isfinite(errors) & np.isfinite(lift.quality)
    if known.sum() < 1 / WORST:
        return float("nan")
    worst = errors[known] > np.quantile(errors[known], 1 - WORST)
    return area_under_curve(-lift.quality[known].astype(np.float64), worst)


def area_under_curve(scores: Float64, which: Bool) -> float:
    """Return how often one of `which` has a larger score than one of the others; ties count half.

    NaN if there are none of either.
    """
    count = int(which.sum())
    others = len(which) - count
    if not count or not others:
        return float("nan")
    return float((rankdata(scores)[which].sum() - count * (count + 1) / 2) / (count * others))


def errors_of(points: Float64, truth: Float64) -> Float64:
    """Return errors (N,) of aligned structures (N, P, 3), shares of the true size; NaN if unknown.

    Both are root mean squares over the points that a structure has.
    """
    moved = procrustes_by_size(points, truth)
    known: Bool = np.all(np.isfinite(moved) & np.isfinite(truth), axis=-1)
    true = np.where(known[..., None], truth, np.nan)
    size = np.nanvar(true, 1).sum(-1)
    return np.asarray(np.sqrt(np.nanmean(np.square(moved - truth).sum(-1), 1) / size))
