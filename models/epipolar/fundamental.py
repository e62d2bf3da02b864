"""The fundamental matrix of two views at rest, from all keypoints of all frames, robustly.

Hartley & Zisserman, *Multiple View Geometry*: the normalised eight-point algorithm (alg. 11.1) and
the Sampson distance (11.9); outliers by iteratively reweighted least squares with the weights of
Student's t. They begin at the best of many small samples (Fischler & Bolles, RANSAC): from the
least-squares solution alone, one correspondence in five that is wrong leads them astray.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

LEAST_POINTS = 8
FREEDOM = 3.0  # degrees of freedom of Student's t: heavier tails than any detector's
NORMAL = 1.4826  # standard deviations in a median absolute deviation
ROUNDS = 8
SAMPLES, SAMPLED_POINTS = 48, 9  # small samples that are tried as a start, and their size
JUDGING_POINTS = 256  # by which they are judged
TINY = 1e-12


class Fundamental(NamedTuple):
    """F with y^T F x = 0 for a point x (pixels, first view) and y (second view)."""

    matrix: Float64  # (3, 3) of Frobenius norm 1
    scale: float  # pixels, robust standard deviation of the Sampson distances


def fit_fundamental(
    x: Float64, y: Float64, weights: Float64 | None = None, *, floor: float = 0.01
) -> Fundamental:
    """Fit a fundamental matrix to correspondences x, y (M, 2) in pixels, of `weights` (M,).

    The scale of the noise is estimated on the way and is not below `floor` pixels.

    Raises
    ------
    ValueError
        When there are fewer than eight correspondences.
    """
    if len(x) < LEAST_POINTS:
        raise ValueError(f"a fundamental matrix needs {LEAST_POINTS} correspondences, got {len(x)}")
    given = np.ones(len(x)) if weights is None else weights
    to_x, to_y = _normalising(x), _normalising(y)
    rows = _equations(_homogeneous(x) @ to_x.T, _homogeneous(y) @ to_y.T)  # (M, 9)
    matrix = _start(rows, given, to_x, to_y, x, y)
    for _ in range(ROUNDS):
        gradients = _gradient_norms(matrix, x, y)
        distances = _algebraic(matrix, x, y) / gradients
        scale = max(robust_scale(distances), floor)
        # Sampson's denominator makes algebraic distances those of pixels.
        share = gradients / np.median(gradients)
        robust = student_weights(distances, scale) / np.square(share)
        matrix = _in_pixels(_solve(rows, given * robust), to_x, to_y)
    scale = max(robust_scale(sampson_distances(matrix, x, y)), floor)
    return Fundamental(matrix, scale)


def sampson_distances(matrix: Float64, x: Float64, y: Float64) -> Float64:
    """Signed Sampson distances (M,) in pixels of correspondences x, y (M, 2) from F (3, 3)."""
    distances: Float64 = _algebraic(matrix, x, y) / _gradient_norms(matrix, x, y)
    return distances


def robust_scale(distances: Float64) -> float:
    """Return the standard deviation of a Gaussian with the median of these absolute distances."""
    return NORMAL * float(np.median(np.abs(distances)))


def student_weights(distances: Float64, scale: float) -> Float64:
    """Weights of least squares that make its optimum the most likely one under Student's t."""
    weights: Float64 = (FREEDOM + 1) / (FREEDOM + np.square(distances / scale))
    return weights


def robust_cost(distances: Float64, scale: float) -> float:
    """Mean negative log likelihood of distances under Student's t of a scale, up to a constant."""
    squared = np.square(distances / scale) / FREEDOM
    return float((FREEDOM + 1) / 2 * np.log1p(squared).mean() + np.log(scale))


def _homogeneous(points: Float64) -> Float64:
    return np.concatenate((points, np.ones((len(points), 1))), 1)


def _normalising(points: Float64) -> Float64:
    """Return the similarity (3, 3) that centres points (M, 2) at a mean distance of sqrt(2)."""
    centre = np.median(points, 0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(points - centre, axis=1).mean()), TINY)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])


def _equations(x: Float64, y: Float64) -> Float64:
    return (y[:, :, None] * x[:, None]).reshape(len(x), 9)


def _solve(rows: Float64, weights: Float64) -> Float64:
    """Return the matrix of rank two next to the least-squares solution."""
    vectors = np.linalg.eigh((rows * weights[:, None]).T @ rows)[1]
    u, s, vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    matrix: Float64 = (u * [s[0], s[1], 0.0]) @ vt
    return matrix


def _in_pixels(matrix: Float64, to_x: Float64, to_y: Float64) -> Float64:
    pixels: Float64 = to_y.T @ matrix @ to_x
    pixels /= np.linalg.norm(pixels, axis=(-2, -1), keepdims=True)
    return pixels


def _start(
    rows: Float64, weights: Float64, to_x: Float64, to_y: Float64, x: Float64, y: Float64
) -> Float64:
    """Return the matrix (3, 3) of least median distance, of all points or of a small sample."""
    rng = np.random.default_rng(0)
    everything = _in_pixels(_solve(rows, weights), to_x, to_y)
    samples = rng.integers(0, len(rows), (SAMPLES, SAMPLED_POINTS))
    sampled = rows[samples]  # (S, 9, 9)
    vectors = np.linalg.eigh(sampled.mT @ sampled)[1][..., 0]
    tried = np.concatenate((everything[None], _in_pixels(vectors.reshape(-1, 3, 3), to_x, to_y)))
    judges = rng.integers(0, len(rows), JUDGING_POINTS) if len(x) > JUDGING_POINTS else slice(None)
    hx, hy = _homogeneous(x[judges]), _homogeneous(y[judges])  # (J, 3)
    lines_y, lines_x = hx @ tried.mT, hy @ tried  # (S + 1, J, 3)
    slopes = np.square(lines_y[..., :2]).sum(-1) + np.square(lines_x[..., :2]).sum(-1)
    squares = np.square((lines_y * hy).sum(-1)) / (slopes + TINY**2)  # of Sampson distances
    best: Float64 = tried[int(np.median(squares, 1).argmin())]
    return best


def _algebraic(matrix: Float64, x: Float64, y: Float64) -> Float64:
    products: Float64 = ((_homogeneous(x) @ matrix.T) * _homogeneous(y)).sum(1)
    return products


def _gradient_norms(matrix: Float64, x: Float64, y: Float64) -> Float64:
    """Length (M,) of the gradient of y^T F x by the four pixel coordinates."""
    lines_y = (_homogeneous(x) @ matrix.T)[:, :2]
    lines_x = (_homogeneous(y) @ matrix)[:, :2]
    norms: Float64 = np.sqrt(np.square(lines_y).sum(1) + np.square(lines_x).sum(1) + TINY**2)
    return norms
