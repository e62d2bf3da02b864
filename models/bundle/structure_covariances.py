"""Covariances of each frame's structure, with poses marginalised; compiled."""

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame import LEAST_DAMPING
from models.bundle.frame_equations import NormalEquations, eliminate, equations_of_frame
from models.bundle.problem import Rig, Scene, ShapePrior, Views
from models.bundle.separate_frames import FRAMES_AT_A_TIME, normal_equations
from models.bundle.shape_model import StructureCovariances
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import cholesky, fill
from models.numerics.threads import empty_aligned, in_slices

Float64 = NDArray[np.float64]


def structure_covariances(
    views: Views, rig: Rig, prior: ShapePrior, scene: Scene
) -> StructureCovariances:
    """Return covariances of the structures of N frames about their best values (Laplace).

    NaN for a frame whose normal equations are not positive definite.
    """
    equations = normal_equations(views, rig, prior, scene, shared=False)
    frames, count, _, size = equations.coupling.shape
    covariances = StructureCovariances(
        empty_aligned(frames, count, 3, 3), empty_aligned(frames, 3 * count, size)
    )
    in_slices(
        frames,
        FRAMES_AT_A_TIME,
        lambda part: _covariances(equations, part.start, part.stop, covariances),
    )
    return covariances


@compiled
def _covariances(
    equations: NormalEquations, start: int, stop: int, out: StructureCovariances
) -> None:
    size = equations.coupling.shape[3]
    factor, right = np.empty((size, size)), np.empty(size)
    for n in range(start, stop):
        own = equations_of_frame(equations, n)
        eliminate(own, LEAST_DAMPING, out.blocks[n], factor, right)
        if cholesky(factor):
            _carry(own, out.blocks[n], factor, out.factors[n])
        else:
            fill(out.blocks[n], np.nan)
            fill(out.factors[n], np.nan)


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
