"""Eigenvalues of covariances, and their expectation for white noise."""

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def falling_eigenvalues(centred: Float64) -> tuple[Float64, Float64]:
    """Eigenvalues (D,), falling, and eigenvectors (D, D) of the covariance of rows (N, D)."""
    values, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    return np.maximum(values[::-1], 1e-12), vectors[:, ::-1]


def white_eigenvalues(rows: int, columns: int) -> Float64:
    """Eigenvalues (D,), falling, of the covariance of white noise (N, D) of variance 1."""
    return falling_eigenvalues(np.random.default_rng(0).standard_normal((rows, columns)))[0]
