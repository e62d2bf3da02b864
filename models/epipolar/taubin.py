"""Fundamental matrices of least mean square distance, many at once, from sums over points.

Taubin (*Estimation of Planar Curves, Surfaces, and Nonplanar Space Curves*, PAMI 1991) divides the
mean square of an algebraic error by that of its gradient: a generalised eigenvalue problem, whose
least value is nearly the mean square of Sampson distances. Affine cameras have a matrix with five
entries, whose gradient is constant.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]

RIDGE = 1e-9  # of the mean square of gradients: what no point determines stays finite


class Reduced(NamedTuple):
    """An ordinary eigenvalue problem, with the matrices' last entry eliminated."""

    matrix: Float64  # (..., q - 1, q - 1) symmetric
    root: Float64  # (..., q - 1, q - 1) Cholesky factor of the gradients' mean square
    last: Float64  # (..., q - 1) the last entry is minus its product with the others

    def best(self) -> Float64:
        """Return the vectors (..., q) of least mean square distance."""
        least = np.linalg.eigh(self.matrix)[1][..., :1]
        others = np.linalg.solve(self.root.mT, least)
        return np.concatenate((others, -self.last[..., None, :] @ others), -2)[..., 0]


def reduced(normal: Float64, gradients: Float64) -> Reduced:
    """Return the eigenvalue problem of sums of row row^T (..., q, q), the last of row being 1.

    `gradients` (..., q - 1, q - 1) are the sums of products of the rows' gradients.
    """
    total = np.maximum(normal[..., -1, -1], TINY)[..., None]
    last = normal[..., -1, :-1] / total
    centred = normal[..., :-1, :-1] - normal[..., :-1, -1:] * last[..., None, :]
    size = gradients.shape[-1]
    ridge = RIDGE * np.trace(gradients, axis1=-2, axis2=-1) / size + TINY
    root = np.linalg.cholesky(gradients + ridge[..., None, None] * np.eye(size))
    half = np.linalg.solve(root, centred)
    return Reduced(np.linalg.solve(root, half.mT), root, last)


def gradients_of(of_x: Float64, of_y: Float64) -> Float64:
    """Return the gradients' sums (..., 8, 8) from those of x x^T and y y^T (..., 3, 3)."""
    shape = of_x.shape[:-2]
    sums = np.zeros((*shape, 3, 3, 3, 3))
    for axis in range(2):
        sums[..., axis, :, axis, :] += of_x
        sums[..., :, axis, :, axis] += of_y
    return sums.reshape(*shape, 9, 9)[..., :8, :8]
