"""Covariances of each frame's structure, with poses marginalised; compiled."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.elimination import dot
from models.bundle.frame import LEAST_DAMPING
from models.bundle.frame_equations import NormalEquations, eliminate, equations_of_frame
from models.bundle.problem import Rig, Scene, ShapePrior, Views
from models.bundle.scene_adjustment import FRAMES_AT_A_TIME, normal_equations
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, fill
from models.numerics.threads import empty_aligned, in_slices

Float64 = NDArray[np.float64]


def structure_covariances(views: Views, rig: Rig, prior: ShapePrior, scene: Scene) -> Float64:
    """Return covariances (N, 3 P, 3 P) of the structures about their best values (Laplace).

    NaN for a frame whose normal equations are not positive definite.
    """
    equations = normal_equations(views, rig, prior, scene, shared=False)
    frames, count, _ = scene.points.shape
    covariances = empty_aligned(frames, 3 * count, 3 * count)
    in_slices(
        frames,
        FRAMES_AT_A_TIME,
        lambda part: _covariances(equations, part.start, part.stop, covariances),
    )
    return covariances


@compiled
def _covariances(equations: NormalEquations, start: int, stop: int, out: Float64) -> None:
    count, size = equations.coupling.shape[1], equations.coupling.shape[3]
    inverses, right = np.empty((count, 3, 3)), np.empty(size)
    factor, carried = np.empty((size, size)), np.empty((3 * count, size))
    for n in range(start, stop):
        own = equations_of_frame(equations, n)
        eliminate(own, LEAST_DAMPING, inverses, factor, right)
        if not cholesky(factor):
            fill(out[n], np.nan)
            continue
        # The covariance is the inverse blocks, and the product of these rows.
        _carry(own, inverses, factor, carried)
        for a in range(3 * count):
            for b in range(a + 1):
                out[n, a, b] = dot(carried[a], carried[b])
                out[n, b, a] = out[n, a, b]
        for p in range(count):
            for i in range(3):
                for j in range(3):
                    out[n, 3 * p + i, 3 * p + j] += inverses[p, i, j]


@inner
def _carry(own: NormalEquations, inverses: Float64, factor: Float64, carried: Float64) -> None:
    """Write L^-1 (inverse block times coupling) of every coordinate, rows of (3 P, R)."""
    size = len(factor)
    for p in range(len(inverses)):
        for i in range(3):
            x, y, z = inverses[p, i]
            row, coupling = carried[3 * p + i], own.coupling[p]  # (R,), (3, R)
            for a in range(size):
                row[a] = x * coupling[0, a] + y * coupling[1, a] + z * coupling[2, a]
            for a in range(size):
                total = row[a]
                for b in range(a):
                    total -= factor[a, b] * row[b]
                row[a] = total / factor[a, a]
