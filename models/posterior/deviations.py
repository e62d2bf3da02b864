"""From answers and keypoints to how far points may be off, without leaving machine code."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig
from models.capture.observations import Observations
from models.network.answers import Answers
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import total
from models.posterior.answers import fill_frames, make_frames
from models.posterior.frames import (
    Covariances,
    Frames,
    LearntShapes,
    make_covariances,
    write_covariances,
)
from models.posterior.quality import factor_of_shapes, write_figures

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

NOTHING = 1e-12  # of all variances, what is left of one by rounding


class Deviations(NamedTuple):
    """How far the points of N frames may be off; see `Answers`."""

    sds: Float32  # (N, P)
    covariances: Float32  # (N, P, 6), or (N, P, 0) if they are not wanted
    modes: Float32  # (N, P, 3, MODES), or (N, P, 3, 0)
    figures: Float64  # (N, 3) of `models.posterior.quality`


class Noise(NamedTuple):
    """What K views of a lift are known to have of it, and what a lift leaves of it."""

    deviations: Float64  # (K, P) pixels, of a coordinate of confidence 1
    # Of frames one by one, and of frames that were smoothed in time: the share that is left before
    # a lift, and corrections of points that no view shows, one view, two, ...
    left: Float64  # (2,)
    corrections: Float64  # (2, V + 1), of V >= K views


@compiled
def write_deviations(
    answers: Answers,
    rig: Rig,
    seen: Observations,
    detected: Float32,
    smoothed: Bool,
    shapes: LearntShapes,
    noise: Noise,
    factor: Float64,
    start: int,
    stop: int,
    out: Deviations,
) -> None:
    """Write what `Posterior.deviations` returns, for frames from `start` to `stop`.

    A frame without a perspective camera stays as it is. Covariances and modes are only written if
    there is room for them.
    """
    some, views = stop - start, len(noise.deviations)
    frames = frames_as_detected(answers, rig, seen, detected, smoothed, shapes, noise, start, stop)
    full, of_shapes = out.covariances.shape[2] > 0, factor_of_shapes(shapes)
    found = make_covariances(some, shapes, factor, full)
    write_covariances(frames, shapes, factor, 0, some, found)
    for n in range(start, stop):
        placed = False
        for k in range(views):
            placed = placed or answers.camera_models[n, k] > 0
        if placed and math.isfinite(found.blocks[n - start, 0, 0, 0]):
            _write(found, n - start, full, n, out)
            write_figures(frames, n - start, shapes, of_shapes, out.sds[n], out.figures[n])


@compiled
def frames_as_detected(
    answers: Answers,
    rig: Rig,
    seen: Observations,
    detected: Float32,
    smoothed: Bool,
    shapes: LearntShapes,
    noise: Noise,
    start: int,
    stop: int,
) -> Frames:
    """Return frames from `start` to `stop` with keypoints as they were before noise was removed."""
    some, (views, count) = stop - start, noise.deviations.shape
    keypoints, weights = np.zeros((some, views, count, 2)), np.zeros((some, views, count))
    for n in range(start, stop):
        for k in range(views):
            for p in range(count):
                weights[n - start, k, p] = seen.weights[n, k, p]
                known = len(detected) > 0 and detected[n, k, p, 2] > 0
                for i in range(2):
                    pixel = seen.keypoints[n, k, p, i] * seen.sizes[n, k] + seen.centres[n, k, i]
                    keypoints[n - start, k, p, i] = detected[n, k, p, i] if known else pixel
    frames = make_frames(keypoints, rig)
    fill_frames(answers, rig, shapes.mean, weights, noise.deviations, start, stop, start, frames)
    for n in range(some):
        removed = int(smoothed[start + n])
        of_views = noise.corrections[removed]
        for p in range(count):
            showing = 0
            for k in range(views):
                if weights[n, k, p] > 0:
                    showing += 1
                # Only now: how far a keypoint lies off is judged by the noise that it had.
                frames.weights[n, k, p] /= noise.left[removed] ** 2
            frames.corrections[n, p] = of_views[showing]
    return frames


@inner
def _write(found: Covariances, m: int, full: bool, n: int, out: Deviations) -> None:
    """Write frame m of what was found as frame n of `out`."""
    for p in range(found.blocks.shape[1]):
        block, squared, number = found.blocks[m, p], 0.0, 0
        for i in range(3):
            squared += block[i, i]
            for j in range(i, 3 if full else i):
                out.covariances[n, p, number] = block[i, j]
                number += 1
        out.sds[n, p] = math.sqrt(max(squared, 0.0))
    if full:
        _write_modes(found.modes[m], found.by_cameras[m], out.modes[n])


@inner
def _write_modes(modes: Float64, by_cameras: Float64, out: Float32) -> None:
    """Write a few modes (P, 3, r) that carry most of the given ones (P, 3, C) and (P, 3, T).

    They are columns of the Cholesky factor of their covariance, pivoted by the largest variance
    that is left (Higham, *Cholesky factorization*, 2009).
    """
    count, _, most = out.shape
    rows, size = 3 * count, modes.shape[2] + by_cameras.shape[2]
    columns, factor = np.empty((rows, size)), np.zeros((rows, most))
    left = np.zeros(rows)
    for row in range(rows):
        p, i = row // 3, row % 3
        for c in range(size):
            shared = c - modes.shape[2]
            columns[row, c] = by_cameras[p, i, shared] if shared >= 0 else modes[p, i, c]
            left[row] += columns[row, c] ** 2
    least = NOTHING * total(left)
    for mode in range(most):
        pivot = 0
        for row in range(rows):
            if left[row] > left[pivot]:
                pivot = row
        if not left[pivot] > least:
            break
        root = math.sqrt(left[pivot])
        for row in range(rows):
            covariance = 0.0
            for c in range(size):
                covariance += columns[row, c] * columns[pivot, c]
            for c in range(mode):
                covariance -= factor[row, c] * factor[pivot, c]
            factor[row, mode] = covariance / root
        for row in range(rows):
            left[row] -= factor[row, mode] ** 2
    for row in range(rows):
        for mode in range(most):
            out[row // 3, row % 3, mode] = factor[row, mode]
