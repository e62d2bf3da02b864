"""Compiled geometry of a training step; gradients are in `reprojection_gradients`."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled
from models.numerics.matrices import total
from models.optics.weak_perspective import RIDGE, TINY

Floats = NDArray[Any]  # of 32 or 64 bits
PARALLEL = 1e-9  # rows that span less of their squared length than this have no nearest rotation


class Camera(NamedTuple):
    """What solving one camera leaves behind."""

    middle: NDArray[np.float64]  # (5,) weighted means of the points and of the image
    scatter: NDArray[np.float64]  # (3, 3) of the points
    cross: NDArray[np.float64]  # (2, 3) of image and points
    inverse: NDArray[np.float64]  # (3, 3) of the scatter with its ridge
    affine: NDArray[np.float64]  # (2, 3) the linear answer
    guess: NDArray[np.float64]  # (2, 3)
    rows: NDArray[np.float64]  # (2, 3) of the rotation
    polar: NDArray[np.float64]  # (2, 9) of `_nearest`, for the guess and the rotation


@compiled
def new_camera() -> Camera:
    """Make room for what `solve` finds."""
    return Camera(
        np.empty(5),
        np.empty((3, 3)),
        np.empty((2, 3)),
        np.empty((3, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.empty((2, 3)),
        np.empty((2, 9)),
    )


@compiled
def reproject(
    points: Floats,
    normal: Floats,
    turns: Floats,
    keypoints: Floats,
    weights: Floats,
    projected: Floats,
) -> None:
    """Write what `models.network.reprojection.reproject` returns."""
    camera = new_camera()
    for n in range(len(points)):
        normalise(points[n], normal[n])
        for k in range(turns.shape[1]):
            whole = total(weights[n, k])
            if whole > 0:
                scale = solve(
                    normal[n], keypoints[n, k], weights[n, k], whole, turns[n, k], camera
                )[0]
                _project(normal[n], camera, scale, projected[n, k])
            else:
                projected[n, k] = 0


@compiled
def normalise(points: Floats, out: Floats) -> float:
    """Centre points (P, D), bring them to root-mean-square radius 1; return the radius."""
    count, width = points.shape
    for d in range(width):
        mean = 0.0
        for p in range(count):
            mean += points[p, d]
        mean /= count
        for p in range(count):
            out[p, d] = points[p, d] - mean
    squared = 0.0
    for p in range(count):
        for d in range(width):
            squared += float(out[p, d]) ** 2
    radius = math.sqrt(max(squared / count, TINY))
    for p in range(count):
        for d in range(width):
            out[p, d] /= radius
    return radius


@compiled
def solve(
    points: Floats,
    image: Floats,
    weights: Floats,
    whole: float,
    turn: Floats,
    camera: Camera,
) -> tuple[float, float, float, float]:
    """Solve as `solve_cameras`; the scale and its denominator, the pull, its slope.

    The slope is the derivative of the pull towards the guess by the variance of the points.
    """
    a = b = c = u = v = 0.0
    for p in range(len(points)):
        share = weights[p] / whole
        a += share * points[p, 0]
        b += share * points[p, 1]
        c += share * points[p, 2]
        u += share * image[p, 0]
        v += share * image[p, 1]
    middle, s, m = camera.middle, camera.scatter, camera.cross
    middle[0], middle[1], middle[2], middle[3], middle[4] = a, b, c, u, v
    xx = xy = xz = yy = yz = zz = spread = 0.0
    ux = uy = uz = vx = vy = vz = 0.0
    for p in range(len(points)):
        share = weights[p] / whole
        x, y, z = points[p, 0] - a, points[p, 1] - b, points[p, 2] - c
        i, j = image[p, 0] - u, image[p, 1] - v
        sx, sy, sz = share * x, share * y, share * z
        xx += sx * x
        xy += sx * y
        xz += sx * z
        yy += sy * y
        yz += sy * z
        zz += sz * z
        ux += sx * i
        uy += sy * i
        uz += sz * i
        vx += sx * j
        vy += sy * j
        vz += sz * j
        spread += share * (i * i + j * j)
    s[0, 0], s[0, 1], s[0, 2], s[1, 0], s[1, 1] = xx, xy, xz, xy, yy
    s[1, 2], s[2, 0], s[2, 1], s[2, 2] = yz, xz, yz, zz
    m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2] = ux, uy, uz, vx, vy, vz

    variance = xx + yy + zz + TINY
    ridge = RIDGE * variance
    root = math.sqrt(spread / variance + TINY)
    pull = ridge * root
    _invert(xx + ridge, xy, xz, yy + ridge, yz, zz + ridge, camera.inverse)
    _nearest(turn, camera.guess, camera.polar[0])
    affine, inverse, guess, rows = camera.affine, camera.inverse, camera.guess, camera.rows
    for i in range(2):
        x, y, z = (
            m[i, 0] + pull * guess[i, 0],
            m[i, 1] + pull * guess[i, 1],
            m[i, 2] + pull * guess[i, 2],
        )
        for j in range(3):
            affine[i, j] = inverse[j, 0] * x + inverse[j, 1] * y + inverse[j, 2] * z
    _nearest(affine, rows, camera.polar[1])

    overlap = square = 0.0
    for i in range(2):
        for j in range(3):
            overlap += m[i, j] * rows[i, j]
            square += rows[i, j] * (
                s[j, 0] * rows[i, 0] + s[j, 1] * rows[i, 1] + s[j, 2] * rows[i, 2]
            )
    square += TINY
    slope = RIDGE * (root - spread / (2.0 * variance * root))
    return overlap / square, square, pull, slope


@compiled
def _project(points: Floats, camera: Camera, scale: float, out: Floats) -> None:
    middle, rows = camera.middle, camera.rows
    for i in range(2):
        x, y, z = scale * rows[i, 0], scale * rows[i, 1], scale * rows[i, 2]
        shift = middle[3 + i] - x * middle[0] - y * middle[1] - z * middle[2]
        for p in range(len(points)):
            out[p, i] = x * points[p, 0] + y * points[p, 1] + z * points[p, 2] + shift


@compiled
def _invert(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, out: Floats) -> None:
    """Invert a symmetric 3x3 matrix by its cofactors."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * a + xy * b + xz * c)
    out[0, 0], out[0, 1], out[0, 2] = scale * a, scale * b, scale * c
    out[1, 0], out[1, 1], out[1, 2] = (
        out[0, 1],
        scale * (xx * zz - xz * xz),
        scale * (xy * xz - xx * yz),
    )
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], scale * (xx * yy - xy * xy)


@compiled
def _nearest(matrix: Floats, rows: Floats, polar: Floats) -> None:
    """Find the orthonormal rows nearest to a 2x3 matrix M: U of its polar decomposition M = T U.

    T^2 = M M^T, and a symmetric 2x2 root is (T^2 + det T) / trace T. `polar` gets the trace of T,
    its inverse (3 numbers) and the axis (3) at right angles to the rows; the trace is 0 where rows
    are parallel or zero: then some rotation is nearest, and it has no gradient.
    """
    a = matrix[0, 0] ** 2 + matrix[0, 1] ** 2 + matrix[0, 2] ** 2
    b = matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1] + matrix[0, 2] * matrix[1, 2]
    c = matrix[1, 0] ** 2 + matrix[1, 1] ** 2 + matrix[1, 2] ** 2
    x = matrix[0, 1] * matrix[1, 2] - matrix[0, 2] * matrix[1, 1]
    y = matrix[0, 2] * matrix[1, 0] - matrix[0, 0] * matrix[1, 2]
    z = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    det = math.sqrt(x * x + y * y + z * z)
    if det <= PARALLEL * (a + c) or a + c <= TINY:
        polar[0] = 0.0
        _nearest_to_parallel(matrix, a, c, rows)
        return
    trace = math.sqrt(a + c + 2.0 * det)
    scale = 1.0 / (trace * det)
    polar[0] = trace
    polar[1], polar[2], polar[3] = scale * (c + det), -scale * b, scale * (a + det)
    polar[4], polar[5], polar[6] = x / det, y / det, z / det
    for j in range(3):
        rows[0, j] = polar[1] * matrix[0, j] + polar[2] * matrix[1, j]
        rows[1, j] = polar[2] * matrix[0, j] + polar[3] * matrix[1, j]


@compiled
def _nearest_to_parallel(matrix: Floats, a: float, c: float, rows: Floats) -> None:
    """Find orthonormal rows for M = (cos, sin)^T length v^T: (cos, sin)^T v^T + (-sin, cos)^T w^T.

    Any w at right angles to v will do.
    """
    length = math.sqrt(a + c)
    if length <= 1e-6:
        rows[:] = 0
        rows[0, 0] = rows[1, 1] = 1
        return
    i = 0 if a >= c else 1
    size = math.sqrt(max(a, c))
    x, y, z = matrix[i, 0] / size, matrix[i, 1] / size, matrix[i, 2] / size
    cos = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z
    sin = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z
    cos, sin = cos / length, sin / length
    if abs(x) <= min(abs(y), abs(z)):
        p, q, r = 0.0, -z, y
    elif abs(y) <= abs(z):
        p, q, r = z, 0.0, -x
    else:
        p, q, r = -y, x, 0.0
    size = math.sqrt(p * p + q * q + r * r)
    p, q, r = p / size, q / size, r / size
    rows[0, 0], rows[0, 1], rows[0, 2] = cos * x - sin * p, cos * y - sin * q, cos * z - sin * r
    rows[1, 0], rows[1, 1], rows[1, 2] = sin * x + cos * p, sin * y + cos * q, sin * z + cos * r


@compiled
def fill(
    projected: Floats, keypoints: Floats, weights: Floats, filled: Floats, sizes: Floats
) -> None:
    """Write what `models.network.reprojection.fill` returns, and the size that each view had."""
    views, count = projected.shape[1:3]
    mixed = np.empty(projected.shape[2:])
    for n in range(len(projected)):
        for k in range(views):
            for p in range(count):
                weight = weights[n, k, p]
                for d in range(2):
                    seen, hidden = keypoints[n, k, p, d], projected[n, k, p, d]
                    mixed[p, d] = weight * seen + (1.0 - weight) * hidden
            sizes[n, k] = normalise(mixed, filled[n, k])
