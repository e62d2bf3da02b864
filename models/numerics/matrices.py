"""Compiled linear algebra of small matrices, written into arrays of the caller."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import inner

Float64 = NDArray[np.float64]
Array = NDArray[Any]


@inner
def copy(source: Array, target: Array) -> None:
    """Copy an array to one of its size; both contiguous. Compiles faster than an assignment."""
    numbers, places = source.ravel(), target.ravel()
    for i in range(len(places)):
        places[i] = numbers[i]


@inner
def fill(target: Array, value: float) -> None:
    """Fill a contiguous array."""
    places = target.ravel()
    for i in range(len(places)):
        places[i] = value


@inner
def total(numbers: Array) -> float:
    """Sum an array of one dimension; of flags, how many are set."""
    result = 0.0
    for i in range(len(numbers)):
        result += numbers[i]
    return result


@inner
def inverse(a: Float64, out: Float64) -> None:
    """Invert a 3x3 matrix by its cofactors."""
    x = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    y = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    z = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    scale = 1.0 / (a[0, 0] * x + a[0, 1] * y + a[0, 2] * z)
    out[0, 0], out[1, 0], out[2, 0] = scale * x, scale * y, scale * z
    out[0, 1] = scale * (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2])
    out[1, 1] = scale * (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0])
    out[2, 1] = scale * (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1])
    out[0, 2] = scale * (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1])
    out[1, 2] = scale * (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2])
    out[2, 2] = scale * (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])


@inner
def inverse_symmetric(a: Float64, ridge: float, out: Float64) -> None:
    """Invert a symmetric 3x3 matrix, with `ridge` added to its diagonal, by its cofactors.

    Only the upper half of `a` is read.
    """
    xx, yy, zz = a[0, 0] + ridge, a[1, 1] + ridge, a[2, 2] + ridge
    xy, xz, yz = a[0, 1], a[0, 2], a[1, 2]
    x, y, z = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * x + xy * y + xz * z)
    out[0, 0], out[0, 1], out[0, 2] = scale * x, scale * y, scale * z
    out[1, 1] = scale * (xx * zz - xz * xz)
    out[1, 2] = scale * (xy * xz - xx * yz)
    out[2, 2] = scale * (xx * yy - xy * xy)
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@inner
def cholesky(a: Float64) -> bool:
    """Factorise a symmetric matrix in place, L of a = L L^T in its lower half; False if it fails.

    Only the lower half is read.
    """
    size = len(a)
    for i in range(size):
        for j in range(i):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / a[j, j]
        total = a[i, i]
        for k in range(i):
            total -= a[i, k] * a[i, k]
        if not total > 0.0:
            return False
        a[i, i] = math.sqrt(total)
    return True


@inner
def cholesky_solve(factor: Float64, x: Float64) -> None:
    """Solve L L^T y = x for a vector, in place."""
    size = len(x)
    for i in range(size):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        x[i] /= factor[i, i]
        for k in range(i):
            x[k] -= factor[i, k] * x[i]


@inner
def identity(out: Float64) -> None:
    """Write the 3x3 identity matrix."""
    for i in range(3):
        for j in range(3):
            out[i, j] = 1.0 if i == j else 0.0


@inner
def product(a: Float64, b: Float64, out: Float64) -> None:
    """Multiply 3x3 matrices; `out` must be another array."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
