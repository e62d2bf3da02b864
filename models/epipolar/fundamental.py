"""The fundamental matrix of two static views, from all keypoints of all frames, robustly.

Hartley & Zisserman, *Multiple View Geometry*: the normalised eight-point algorithm (alg. 11.1) and
the Sampson distance (11.9); outliers by iteratively reweighted least squares with the weights of
Student's t. They start at the best of many small samples (Fischler & Bolles, RANSAC): started from
the least-squares solution, they fail if one correspondence in five is wrong.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled
from models.numerics.medians import NORMAL
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]

LEAST_POINTS = 8
FREEDOM = 3.0  # degrees of freedom of Student's t: heavier tails than any detector's
ROUNDS = 8
SAMPLES, SAMPLED_POINTS = 48, 9  # small samples that are tried as a start, and their size
JUDGING_POINTS = 256  # by which they are judged
MOST_OFFSET = 3.0  # standard deviations, so that outliers do not decide
LEAST_SHOWN = 3  # keypoints of a frame


class Fundamental(NamedTuple):
    """F with y^T F x = 0 for a point x (pixels, first view) and y (second view)."""

    matrix: Float64  # (3, 3) of Frobenius norm 1
    scale: float  # pixels, robust standard deviation of the Sampson distances


def fit_fundamental(
    x: Float64,
    y: Float64,
    weights: Float64 | None = None,
    *,
    floor: float = 0.01,
    start: Float64 | None = None,
) -> Fundamental:
    """Fit a fundamental matrix to correspondences x, y (M, 2) in pixels, of `weights` (M,).

    The scale of the noise is estimated on the way and is not below `floor` pixels. A matrix (3, 3)
    to `start` from saves the search for one.

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
    matrix = _start(rows, given, to_x, to_y, x, y) if start is None else start
    seen = given > 0
    for _ in range(ROUNDS):
        errors, gradients = _epipolar_errors(matrix, x, y)
        distances = errors / gradients
        scale = max(robust_scale(distances[seen]), floor)
        # Sampson's denominator makes algebraic distances those of pixels.
        share = gradients / np.median(gradients[seen])
        robust = student_weights(distances, scale) / np.square(share)
        matrix = _in_pixels(_solve(rows, given * robust), to_x, to_y)
    distances = sampson_distances(matrix, x, y)
    return Fundamental(matrix, max(robust_scale(distances[seen]), floor))


def sampson_distances(matrix: Float64, x: Float64, y: Float64) -> Float64:
    """Signed Sampson distances (..., M) in pixels of x, y (..., M, 2) from F (..., 3, 3)."""
    errors, gradients = _epipolar_errors(matrix, x, y)
    distances: Float64 = errors / gradients
    return distances


def robust_scale(distances: Float64) -> float:
    """Return the standard deviation of a Gaussian with the median of these absolute distances."""
    return NORMAL * float(np.median(np.abs(distances)))


def common_offsets(distances: Float64, frames: NDArray[np.int64]) -> float:
    """Return how much more frames' mean distances vary than independent ones would; about 1.

    If cameras move, a frame has a geometry of its own, and all its keypoints are off together.
    `distances` (M,) are signed, in standard deviations, of these `frames` (M,). NaN if no frame has
    enough of them.
    """
    offsets = distances.clip(-MOST_OFFSET, MOST_OFFSET)
    counts = np.bincount(frames)
    enough = counts > LEAST_SHOWN
    if not enough.any():
        return np.nan
    sums, squares = np.bincount(frames, offsets)[enough], np.bincount(frames, offsets**2)[enough]
    shared = np.square(sums) / counts[enough]
    within = (squares - shared) / (counts[enough] - 1)
    return float(shared.mean() / max(within.mean(), TINY))


def student_weights(distances: Float64, scale: float | Float64) -> Float64:
    """Weights of least squares that make its optimum the most likely one under Student's t."""
    weights: Float64 = (FREEDOM + 1) / (FREEDOM + np.square(distances / scale))
    return weights


def robust_costs(distances: Float64, scale: float | Float64) -> Float64:
    """Negative log likelihoods of distances under Student's t of a scale, up to a constant."""
    squared = np.square(distances / scale) / FREEDOM
    costs: Float64 = (FREEDOM + 1) / 2 * np.log1p(squared) + np.log(scale)
    return costs


def _homogeneous(points: Float64) -> Float64:
    homogeneous = np.ones((*points.shape[:-1], 3))
    homogeneous[..., :2] = points
    return homogeneous


def _normalising(points: Float64) -> Float64:
    """Return the similarity (3, 3) that centres points (M, 2) at a mean distance of sqrt(2)."""
    centre = np.median(points, 0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(points - centre, axis=1).mean()), TINY)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]])


def _equations(x: Float64, y: Float64) -> Float64:
    return (y[..., :, None] * x[..., None, :]).reshape(*x.shape[:-1], 9)


def _solve(rows: Float64, weights: Float64) -> Float64:
    """Return the matrices (..., 3, 3) of rank two next to the least-squares solutions."""
    vectors = np.linalg.eigh((rows * weights[..., None]).mT @ rows)[1]
    u, s, vt = np.linalg.svd(vectors[..., 0].reshape(*vectors.shape[:-2], 3, 3))
    matrices: Float64 = (u * (s * [1.0, 1.0, 0.0])[..., None, :]) @ vt
    return matrices


def _in_pixels(matrix: Float64, to_x: Float64, to_y: Float64) -> Float64:
    pixels: Float64 = to_y.mT @ matrix @ to_x
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
    distances = np.abs(sampson_distances(tried, x[judges], y[judges]))  # (S + 1, J)
    best: Float64 = tried[int(np.median(distances, 1).argmin())]
    return best


def _epipolar_errors(matrix: Float64, x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Return y^T F x and the length of its gradient by the four pixel coordinates, (..., M) each.

    Of points x, y (..., M, 2) and matrices (..., 3, 3), each with the same leading axes or none.
    """
    shape = np.broadcast_shapes(matrix.shape[:-2], x.shape[:-2], y.shape[:-2]) + x.shape[-2:-1]
    matrices, x, y = (
        np.ascontiguousarray(a).reshape(math.prod(a.shape[:-2]), *a.shape[-2:])
        for a in (matrix, x, y)
    )
    errors, norms = np.empty((2, max(len(matrices), len(x), len(y)), shape[-1]))
    _write_epipolar_errors(matrices, x, y, errors, norms)
    return errors.reshape(shape), norms.reshape(shape)


@compiled
def _write_epipolar_errors(
    matrices: Float64, x: Float64, y: Float64, errors: Float64, norms: Float64
) -> None:
    """Write both (B, M), of B matrices and points or of one for all."""
    for b in range(len(errors)):
        f, own_x, own_y = matrices[b % len(matrices)], x[b % len(x)], y[b % len(y)]
        for m in range(errors.shape[1]):
            x0, x1, y0, y1 = own_x[m, 0], own_x[m, 1], own_y[m, 0], own_y[m, 1]
            # F x, and the first two numbers of F^T y
            line0 = f[0, 0] * x0 + f[0, 1] * x1 + f[0, 2]
            line1 = f[1, 0] * x0 + f[1, 1] * x1 + f[1, 2]
            line2 = f[2, 0] * x0 + f[2, 1] * x1 + f[2, 2]
            back0 = f[0, 0] * y0 + f[1, 0] * y1 + f[2, 0]
            back1 = f[0, 1] * y0 + f[1, 1] * y1 + f[2, 1]
            errors[b, m] = y0 * line0 + y1 * line1 + line2
            norms[b, m] = math.sqrt(line0**2 + line1**2 + back0**2 + back1**2 + TINY**2)
