"""Rotations: from vectors (Rodrigues), and nearest to matrices (Kabsch), one of each.

Functions that end in `_into` are for compiled functions and write one rotation into an array of the
caller; the others take NumPy arrays with any leading dimensions.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, identity
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Floats = NDArray[Any]  # of 32 or 64 bits

SWEEPS = 30  # of Jacobi rotations at most; four or five are the rule
ZERO_LENGTH = 1e-6  # its root
PARALLEL = 1e-9  # rows that span less than this share of their squared length count as parallel


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


def rotations_from_rows(matrices: Floats) -> Float64:
    """Rotations (..., 3, 3) whose first two rows are nearest to those of matrices (..., 2, 3)."""
    flat = np.ascontiguousarray(matrices[..., :2, :]).reshape(-1, 2, 3)
    out = np.empty((len(flat), 3, 3))
    _rotations_from_rows(flat, out)
    return out.reshape(*matrices.shape[:-2], 3, 3)


@compiled
def _rotations_from_rows(matrices: Floats, out: Float64) -> None:
    for n in range(len(matrices)):
        nearest_orthonormal_rows_into(matrices[n], out[n])


class SymmetricFactor(NamedTuple):
    """The factor T of a 2x3 matrix M = T U, where U has orthonormal rows; see below."""

    unique: bool  # False where the rows of M are parallel or zero: U then has no gradient
    trace: float  # of T; 0 where U is not unique, like what follows
    inverse_xx: float  # T^-1, which is symmetric
    inverse_xy: float
    inverse_yy: float


@inner
def nearest_orthonormal_rows_into(matrix: Floats, rotation: Float64) -> SymmetricFactor:
    """Write the rotation (3, 3) whose first two rows are the orthonormal rows nearest to a matrix.

    They are U of the polar decomposition M = T U (Higham, *Functions of Matrices*, ch. 8), where
    T^2 = M M^T, and a symmetric 2x2 root is (T^2 + det T) / trace T. If the rows of M (2, 3) are
    parallel or zero, many pairs of rows are equally near, and one of them is written. The third
    row is the cross product of the two.
    """
    a = matrix[0, 0] ** 2 + matrix[0, 1] ** 2 + matrix[0, 2] ** 2
    b = matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1] + matrix[0, 2] * matrix[1, 2]
    c = matrix[1, 0] ** 2 + matrix[1, 1] ** 2 + matrix[1, 2] ** 2
    x = matrix[0, 1] * matrix[1, 2] - matrix[0, 2] * matrix[1, 1]
    y = matrix[0, 2] * matrix[1, 0] - matrix[0, 0] * matrix[1, 2]
    z = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    det = math.sqrt(x * x + y * y + z * z)
    if det <= PARALLEL * (a + c) or a + c <= TINY:
        _nearest_to_parallel_rows_into(matrix, a, c, rotation)
        return SymmetricFactor(False, 0.0, 0.0, 0.0, 0.0)
    trace = math.sqrt(a + c + 2.0 * det)
    scale = 1.0 / (trace * det)
    inverse_xx, inverse_xy, inverse_yy = scale * (c + det), -scale * b, scale * (a + det)
    for j in range(3):
        rotation[0, j] = inverse_xx * matrix[0, j] + inverse_xy * matrix[1, j]
        rotation[1, j] = inverse_xy * matrix[0, j] + inverse_yy * matrix[1, j]
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = x / det, y / det, z / det
    return SymmetricFactor(True, trace, inverse_xx, inverse_xy, inverse_yy)


@inner
def _nearest_to_parallel_rows_into(matrix: Floats, a: float, c: float, rotation: Float64) -> None:
    """Write a nearest rotation for rows that are parallel, of squared lengths a and c, or zero.

    M = (cos, sin)^T length v^T has the nearest rows (cos, sin)^T v^T + (-sin, cos)^T w^T, for any
    w at right angles to v.
    """
    length = math.sqrt(a + c)
    if length <= ZERO_LENGTH:
        identity(rotation)
        return
    longer = 0 if a >= c else 1
    size = math.sqrt(max(a, c))
    x, y, z = matrix[longer, 0] / size, matrix[longer, 1] / size, matrix[longer, 2] / size  # v
    cos = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z
    sin = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z
    cos, sin = cos / length, sin / length
    # w: the cross product of v with the axis that v is farthest from.
    if abs(x) <= min(abs(y), abs(z)):
        p, q, r = 0.0, -z, y
    elif abs(y) <= abs(z):
        p, q, r = z, 0.0, -x
    else:
        p, q, r = -y, x, 0.0
    size = math.sqrt(p * p + q * q + r * r)
    p, q, r = p / size, q / size, r / size
    for j, (along, across) in enumerate(((x, p), (y, q), (z, r))):
        rotation[0, j] = cos * along - sin * across
        rotation[1, j] = sin * along + cos * across
    for j in range(3):
        k, m = (j + 1) % 3, (j + 2) % 3
        rotation[2, j] = rotation[0, k] * rotation[1, m] - rotation[0, m] * rotation[1, k]
