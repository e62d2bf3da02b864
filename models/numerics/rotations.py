"""Rotations: from vectors (Rodrigues), and nearest to matrices (Kabsch), one of each.

What ends in `_into` is for compiled functions and writes one rotation into an array that the
caller gives; the others take NumPy arrays with any leading dimensions.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, identity

Float64 = NDArray[np.float64]

SWEEPS = 30  # of Jacobi rotations at most; four or five are the rule
TINY = 1e-12


def rotations_from_vectors(vectors: Float64) -> Float64:
    """Rotations (..., 3, 3) by the length, in radians, and about the axis of vectors (..., 3)."""
    flat = np.ascontiguousarray(vectors, np.float64).reshape(-1, 3)
    out = np.empty((len(flat), 3, 3))
    _rotations_from_vectors(flat, out)
    return out.reshape(*vectors.shape, 3)


@compiled
def _rotations_from_vectors(vectors: Float64, out: Float64) -> None:
    for n in range(len(vectors)):
        rotation_from_vector_into(vectors[n, 0], vectors[n, 1], vectors[n, 2], out[n])


def nearest_rotations(matrices: Float64) -> Float64:
    """Rotations R (..., 3, 3) that maximise trace(R^T M) of matrices M (..., 3, 3): Kabsch, 1978.

    For paired points x and y, stored as rows, R of M = y^T x turns x onto y: `x @ R.T`.
    """
    flat = np.ascontiguousarray(matrices, np.float64).reshape(-1, 3, 3)
    out = np.empty_like(flat)
    _nearest_rotations(flat, out)
    return out.reshape(matrices.shape)


@compiled
def _nearest_rotations(matrices: Float64, out: Float64) -> None:
    for n in range(len(matrices)):
        nearest_rotation_into(matrices[n], out[n])


@inner
def nearest_rotation_into(m: Float64, out: Float64) -> None:
    """Find the rotation nearest to a 3x3 matrix, the one that maximises trace(out^T m).

    Kabsch's solution (1978) from a singular value decomposition by one-sided Jacobi rotations
    (Golub & Van Loan, *Matrix Computations*, 8.6.3).
    """
    u, v = np.empty((3, 3)), np.empty((3, 3))
    copy(m, u)
    identity(v)
    for _ in range(SWEEPS):
        off = 0.0
        for i in range(2):
            for j in range(i + 1, 3):
                a = u[0, i] ** 2 + u[1, i] ** 2 + u[2, i] ** 2
                b = u[0, j] ** 2 + u[1, j] ** 2 + u[2, j] ** 2
                c = u[0, i] * u[0, j] + u[1, i] * u[1, j] + u[2, i] * u[2, j]
                if abs(c) <= 1e-15 * math.sqrt(a * b) or c == 0.0:
                    continue
                off = 1.0
                zeta = (b - a) / (2.0 * c)
                tangent = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
                sine = cosine * tangent
                for k in range(3):
                    u[k, i], u[k, j] = (
                        cosine * u[k, i] - sine * u[k, j],
                        sine * u[k, i] + cosine * u[k, j],
                    )
                    v[k, i], v[k, j] = (
                        cosine * v[k, i] - sine * v[k, j],
                        sine * v[k, i] + cosine * v[k, j],
                    )
        if off == 0.0:
            break
    # The two longest columns are right; the third follows by handedness.
    least, lengths = 0, np.empty(3)
    for i in range(3):
        lengths[i] = math.sqrt(u[0, i] ** 2 + u[1, i] ** 2 + u[2, i] ** 2)
        if lengths[i] < lengths[least]:
            least = i
    i, j = (least + 1) % 3, (least + 2) % 3
    first = lengths[i] >= lengths[j]
    _unit_column(u, i if first else j, j if first else i)
    _unit_column(u, j if first else i, i if first else j)
    for k in range(3):
        p, q = (k + 1) % 3, (k + 2) % 3
        u[k, least] = u[p, i] * u[q, j] - u[q, i] * u[p, j]
        v[k, least] = v[p, i] * v[q, j] - v[q, i] * v[p, j]
    for a_ in range(3):
        for b_ in range(3):
            out[a_, b_] = u[a_, 0] * v[b_, 0] + u[a_, 1] * v[b_, 1] + u[a_, 2] * v[b_, 2]


@inner
def _unit_column(u: Float64, i: int, other: int) -> None:
    """Normalise a column; one that is zero becomes some unit vector at a right angle to another."""
    length = math.sqrt(u[0, i] ** 2 + u[1, i] ** 2 + u[2, i] ** 2)
    if length <= 1e-150:
        axis = 0
        for k in range(3):
            if abs(u[k, other]) < abs(u[axis, other]):
                axis = k
        squared = u[0, other] ** 2 + u[1, other] ** 2 + u[2, other] ** 2
        along = u[axis, other] / max(squared, 1e-300)
        for k in range(3):
            u[k, i] = (1.0 if k == axis else 0.0) - along * u[k, other]
        length = math.sqrt(u[0, i] ** 2 + u[1, i] ** 2 + u[2, i] ** 2)
    for k in range(3):
        u[k, i] /= length


@inner
def rotation_from_vector_into(x: float, y: float, z: float, out: Float64) -> None:
    """Write the rotation by the angle and about the axis of a vector: Rodrigues."""
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle < 1e-12:
        sine, versine = 1.0, 0.5
    else:
        sine = math.sin(angle) / angle
        half = math.sin(0.5 * angle)
        versine = 2.0 * half * half / squared
    out[0, 0] = 1.0 - versine * (y * y + z * z)
    out[1, 1] = 1.0 - versine * (x * x + z * z)
    out[2, 2] = 1.0 - versine * (x * x + y * y)
    out[0, 1], out[1, 0] = versine * x * y - sine * z, versine * x * y + sine * z
    out[0, 2], out[2, 0] = versine * x * z + sine * y, versine * x * z - sine * y
    out[1, 2], out[2, 1] = versine * y * z - sine * x, versine * y * z + sine * x


@inner
def nearest_orthonormal_rows_into(m: Float64, out: Float64) -> None:
    """Find the rotation whose first two rows are nearest to a 2x3 matrix.

    As `models.optics.weak_perspective.nearest_rotation`, in which the reasons are given.
    """
    x = out[0]
    y = out[1]
    copy(m[0], x)
    a = _unit(x, x)
    b = x[0] * m[1, 0] + x[1] * m[1, 1] + x[2] * m[1, 2]
    for i in range(3):
        y[i] = m[1, i] - b * x[i]
    d = _unit(y, x)
    again = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    for i in range(3):
        y[i] -= again * x[i]  # digits were lost if d << b
    cosine, sine = a + d + 1e-9, b
    stretch = math.sqrt(cosine * cosine + sine * sine)
    cosine, sine = cosine / stretch, sine / stretch
    for i in range(3):
        x[i], y[i] = cosine * x[i] - sine * y[i], sine * x[i] + cosine * y[i]
    out[2, 0] = x[1] * y[2] - x[2] * y[1]
    out[2, 1] = x[2] * y[0] - x[0] * y[2]
    out[2, 2] = x[0] * y[1] - x[1] * y[0]


@inner
def _unit(vector: Float64, away_from: Float64) -> float:
    """Normalise and return the length; a zero turns away from a unit vector, with length 0."""
    squared = vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2
    if squared > TINY:
        length = math.sqrt(squared)
        for i in range(3):
            vector[i] /= length
        return length
    axis = 0
    for i in range(3):
        if abs(away_from[i]) < abs(away_from[axis]):
            axis = i
    along = away_from[axis]
    total = 0.0
    for i in range(3):
        vector[i] = (1.0 if i == axis else 0.0) - along * away_from[i]
        total += vector[i] ** 2
    for i in range(3):
        vector[i] /= math.sqrt(total)
    return 0.0
