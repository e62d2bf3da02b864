"""From answers and keypoints to how far points may be off, without leaving machine code."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import fill, total
from models.posterior.answers import Lifted, frames_as_detected
from models.posterior.frames import (
    Covariances,
    make_covariances,
    write_covariances,
)
from models.posterior.quality import factor_of_shapes, write_figures

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

NOTHING = 1e-12  # of all variances, what is left of one by rounding


class Deviations(NamedTuple):
    """How far the points of N frames may be off; see `Answers`."""

    sds: Float32  # (N, P)
    covariances: Float32  # (N, P, 6), or (N, P, 0) if they are not wanted
    modes: Float32  # (N, P, 3, MODES), or (N, P, 3, 0)
    figures: Float64  # (N, 3) of `models.posterior.quality`


@compiled
def write_deviations(
    lifted: Lifted, factor: Float64, start: int, stop: int, out: Deviations
) -> None:
    """Write what `Posterior.deviations` returns, for frames from `start` to `stop`.

    A frame without a perspective camera stays as it is. Covariances and modes are only written if
    there is room for them.
    """
    shapes, some = lifted.shapes, stop - start
    frames = frames_as_detected(lifted, start, stop)
    full, of_shapes = out.covariances.shape[2] > 0, factor_of_shapes(shapes)
    found = make_covariances(some, shapes, factor, full)
    write_covariances(frames, shapes, factor, 0, some, found)
    for n in range(start, stop):
        placed = False
        for k in range(lifted.answers.camera_models.shape[1]):
            placed = placed or lifted.answers.camera_models[n, k] > 0
        if placed and math.isfinite(found.blocks[n - start, 0, 0, 0]):
            _write(found, n - start, full, n, out)
            write_figures(frames, n - start, shapes, of_shapes, out.sds[n], out.figures[n])


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
    rows, own, size = 3 * count, modes.shape[2], modes.shape[2] + by_cameras.shape[2]
    columns, factor = np.empty((size, rows)), np.zeros((most, rows))  # as rows, to be fast
    left, covariances = np.zeros(rows), np.empty(rows)
    fill(out, 0.0)
    for row in range(rows):
        p, i = row // 3, row % 3
        for c in range(size):
            columns[c, row] = modes[p, i, c] if c < own else by_cameras[p, i, c - own]
            left[row] += columns[c, row] ** 2
    least = NOTHING * total(left)
    for mode in range(most):
        pivot = 0
        for row in range(rows):
            if left[row] > left[pivot]:
                pivot = row
        if not left[pivot] > least:
            break
        root = math.sqrt(left[pivot])
        fill(covariances, 0.0)
        for c in range(size):
            here = columns[c, pivot]
            for row in range(rows):
                covariances[row] += columns[c, row] * here
        for c in range(mode):
            here = factor[c, pivot]
            for row in range(rows):
                covariances[row] -= factor[c, row] * here
        for row in range(rows):
            factor[mode, row] = covariances[row] / root
            left[row] -= factor[mode, row] ** 2
            out[row // 3, row % 3, mode] = factor[mode, row]
