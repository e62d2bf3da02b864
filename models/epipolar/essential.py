"""Essential matrices of five correspondences, many samples at once.

Nister, *An efficient solution to the five-point relative pose problem*, 2004, in the form of
Stewenius, Engels and Nister, *Recent developments on direct relative orientation*, 2006: the ten
cubic constraints on E = a A + b B + c C + D, and the eigenvectors of multiplication by a modulo
these.
"""

from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

SAMPLE = 5  # correspondences
REAL = 1e-8  # imaginary part, as a share of the modulus, up to which a root counts as real
RIDGE = 1e-12  # keeps samples with repeated points solvable; their matrices fit nothing
# Monomials of a, b, c and 1 (index 3): of degree two, and of degree three with the cubes first.
_QUADRATIC = list(combinations_with_replacement(range(4), 2))
_CUBIC = sorted(combinations_with_replacement(range(4), 3), key=lambda m: (3 in m, m))
_BASIS = [m[:2] for m in _CUBIC[10:]]  # the monomials of degree two and less, without one 1


def _products(left: list[tuple[int, ...]], out: list[tuple[int, ...]]) -> Float64:
    """Return (L, 4, O): which monomial of `out` is one of `left` times a, b, c or 1."""
    table = np.zeros((len(left), 4, len(out)))
    for i, monomial in enumerate(left):
        for j in range(4):
            table[i, j, out.index(tuple(sorted((*monomial, j))))] = 1
    return table


_LINEAR_TIMES = _products([(i,) for i in range(4)], list(_QUADRATIC))
_QUADRATIC_TIMES = _products(list(_QUADRATIC), list(_CUBIC))


class Essentials(NamedTuple):
    """Essential matrices with y^T E x = 0, and the sample that each comes from."""

    matrices: Float64  # (H, 3, 3)
    samples: NDArray[np.int64]  # (H,)


def five_point(x: Float64, y: Float64) -> Essentials:
    """Return all essential matrices of samples x, y (B, 5, 2): directions at depth one."""
    ones = np.ones((*x.shape[:-1], 1))
    first, second = np.concatenate((x, ones), -1), np.concatenate((y, ones), -1)
    rows = (second[..., :, None] * first[..., None, :]).reshape(len(x), SAMPLE, 9)
    spaces = np.linalg.svd(rows)[2][:, SAMPLE:].reshape(-1, 4, 3, 3)
    constraints = _constraints(np.moveaxis(spaces, 1, -1))  # (B, 10, 20)
    leading = constraints[..., :10] + RIDGE * np.eye(10)
    reduced: Float64 = np.linalg.solve(leading, constraints[..., 10:]).astype(
        np.float64
    )  # cubes in terms of the basis
    values, vectors = _eigen(_multiplication(reduced))
    real = np.abs(values.imag) <= REAL * np.abs(values).clip(1e-300)
    sample, root = np.nonzero(real)
    monomials = vectors.real[sample, :, root]  # (H, 10)
    linear = monomials[:, [_BASIS.index((j, 3)) for j in range(4)]]
    matrices = np.einsum("hj,hjkl->hkl", linear, spaces[sample])
    norms = np.linalg.norm(matrices, axis=(1, 2))
    usable = np.isfinite(norms) & (norms > 0)
    return Essentials(matrices[usable] / norms[usable, None, None], sample[usable])


def _constraints(linear: Float64) -> Float64:
    """Return det E = 0 and 2 E E^T E = tr(E E^T) E of E (B, 3, 3, 4), coefficients (B, 10, 20)."""
    gram = _product(linear, linear.swapaxes(1, 2), _LINEAR_TIMES)
    trace = np.einsum("biir->br", gram)
    gram = 2 * gram - trace[:, None, None] * np.eye(3)[:, :, None]
    cubic = _product(gram, linear, _QUADRATIC_TIMES)
    # The determinant is the first row times the cross product of the second and the third.
    pairs = _product(linear[:, 1, :, None], linear[:, 2, None], _LINEAR_TIMES)  # (B, 3, 3, 10)
    minors = [pairs[:, i, j] - pairs[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))]
    determinant = _product(np.stack(minors, 1)[:, None], linear[:, 0, :, None], _QUADRATIC_TIMES)
    return np.concatenate((cubic.reshape(len(linear), 9, -1), determinant[:, 0]), 1)


def _product(left: Float64, right: Float64, table: Float64) -> Float64:
    """Multiply matrices of polynomials, (B, I, K, P) and (B, K, J, Q), of monomials in `table`.

    `table` (P, Q, R) is 1 where a monomial is the product of two; returns (B, I, J, R).
    """
    batch, rows, inner, terms = left.shape
    _, _, columns, others = right.shape
    first = left.transpose(0, 1, 3, 2).reshape(batch, rows * terms, inner)
    products = first @ right.reshape(batch, inner, columns * others)
    products = products.reshape(batch, rows, terms, columns, others).swapaxes(2, 3)
    flat = products.reshape(batch, rows, columns, terms * others)
    return np.asarray(flat @ table.reshape(terms * others, -1), np.float64)


def _multiplication(reduced: Float64) -> Float64:
    """Return what multiplies the basis by a, modulo the constraints; (B, 10, 10)."""
    matrices = np.zeros((len(reduced), 10, 10))
    for row, monomial in enumerate(_BASIS):
        product = tuple(sorted((0, *monomial)))
        cube = [tuple(cubic) for cubic in _CUBIC].index(product)
        if cube < 10:
            matrices[:, row] = -reduced[:, cube]
        else:
            matrices[:, row, cube - 10] = 1
    return matrices


def _eigen(matrices: Float64) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return complex eigenvalues and eigenvectors, whatever they are."""
    found: Any = np.linalg.eig(matrices)
    return found.eigenvalues.astype(np.complex128), found.eigenvectors.astype(np.complex128)


def decompose(matrices: Float64) -> tuple[Float64, Float64]:
    """Return the four (R, t) of each essential matrix: (H, 4, 3, 3) and unit (H, 4, 3).

    Hartley & Zisserman, *Multiple View Geometry*, result 9.19: y ~ R x + t.
    """
    u, _, vt = np.linalg.svd(matrices)
    u = u * np.linalg.det(u)[:, None, None]
    vt = vt * np.linalg.det(vt)[:, None, None]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    one, other = u @ quarter @ vt, u @ quarter.T @ vt
    t = u[:, :, 2]
    return np.stack((one, one, other, other), 1), np.stack((t, -t, t, -t), 1)
