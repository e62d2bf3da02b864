"""Gradients of the compiled geometry of a training step, derived by hand.

What `by_x` names is the gradient of the loss by x.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.network.reprojection_kernels import Camera, Floats, new_camera, normalise, solve
from models.numerics.compiled import compiled
from models.numerics.matrices import total
from models.optics.weak_perspective import RIDGE


class Gradients(NamedTuple):
    """By what one camera is made of."""

    rows: NDArray[np.float64]  # (2, 3)
    affine: NDArray[np.float64]  # (2, 3)
    cross: NDArray[np.float64]  # (2, 3)
    scatter: NDArray[np.float64]  # (3, 3)


@compiled
def reproject_back(
    points: Floats,
    normal: Floats,
    turns: Floats,
    keypoints: Floats,
    weights: Floats,
    by_normal: Floats,
    by_projected: Floats,
    out_points: Floats,
    out_turns: Floats,
) -> None:
    """Write gradients by points and turns, of `models.network.reprojection_kernels.reproject`."""
    camera = new_camera()
    scratch = np.empty_like(normal[0])
    by_points = np.empty(normal[0].shape)
    by = Gradients(np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((3, 3)))
    for n in range(len(points)):
        radius = normalise(points[n], scratch)
        by_points[:] = by_normal[n]
        for k in range(turns.shape[1]):
            whole = total(weights[n, k])
            if whole > 0:
                _camera_back(
                    normal[n],
                    keypoints[n, k],
                    weights[n, k],
                    whole,
                    turns[n, k],
                    by_projected[n, k],
                    camera,
                    by,
                    by_points,
                    out_turns[n, k],
                )
            else:
                out_turns[n, k] = 0
        _normalise_back(normal[n], radius, by_points, out_points[n])


@compiled
def _camera_back(
    points: Floats,
    image: Floats,
    weights: Floats,
    whole: float,
    turn: Floats,
    by_projected: Floats,
    camera: Camera,
    by: Gradients,
    by_points: Floats,
    by_turn: Floats,
) -> None:
    """Add the gradient by the points of one view, write that by its turn."""
    scale, square, pull, slope = solve(points, image, weights, whole, turn, camera)
    middle, s, m, rows = camera.middle, camera.scatter, camera.cross, camera.rows
    a, b, c, u, v = middle[0], middle[1], middle[2], middle[3], middle[4]

    # w = scale rows (X - mean) + const
    by_rows, by_affine, by_cross, by_scatter = by.rows, by.affine, by.cross, by.scatter
    ux = uy = uz = vx = vy = vz = 0.0
    for p in range(len(points)):
        x, y, z = points[p, 0] - a, points[p, 1] - b, points[p, 2] - c
        i, j = by_projected[p, 0], by_projected[p, 1]
        ux += i * x
        uy += i * y
        uz += i * z
        vx += j * x
        vy += j * y
        vz += j * z
    by_rows[0, 0], by_rows[0, 1], by_rows[0, 2] = ux, uy, uz
    by_rows[1, 0], by_rows[1, 1], by_rows[1, 2] = vx, vy, vz
    by_scale = 0.0
    for i in range(2):
        for j in range(3):
            by_scale += by_rows[i, j] * rows[i, j]
    # scale = <cross, rows> / <rows, rows scatter>
    by_overlap = by_scale / square
    by_square = -by_overlap * scale
    for j in range(3):
        for k in range(3):
            by_scatter[j, k] = by_square * (rows[0, j] * rows[0, k] + rows[1, j] * rows[1, k])
    for i in range(2):
        for j in range(3):
            turned = s[j, 0] * rows[i, 0] + s[j, 1] * rows[i, 1] + s[j, 2] * rows[i, 2]
            by_rows[i, j] = scale * by_rows[i, j] + by_overlap * m[i, j] + 2 * by_square * turned
            by_cross[i, j] = by_overlap * rows[i, j]
    _nearest_back(rows, camera.polar[1], by_rows, by_affine)

    _linear_back(camera, pull, slope, by, by_turn)

    # cross = sum share (w - mean) (X - mean)^T; scatter = sum share (X - mean) (X - mean)^T
    g = by_scatter
    xx, yy, zz = 2 * g[0, 0], 2 * g[1, 1], 2 * g[2, 2]
    xy, xz, yz = g[0, 1] + g[1, 0], g[0, 2] + g[2, 0], g[1, 2] + g[2, 1]
    sum_i = sum_j = 0.0
    for p in range(len(points)):
        sum_i += by_projected[p, 0]
        sum_j += by_projected[p, 1]
    for p in range(len(points)):
        share = weights[p] / whole
        x, y, z = points[p, 0] - a, points[p, 1] - b, points[p, 2] - c
        i = scale * (by_projected[p, 0] - share * sum_i)
        j = scale * (by_projected[p, 1] - share * sum_j)
        q, r = share * (image[p, 0] - u), share * (image[p, 1] - v)
        by_points[p, 0] += (
            rows[0, 0] * i
            + rows[1, 0] * j
            + by_cross[0, 0] * q
            + by_cross[1, 0] * r
            + share * (xx * x + xy * y + xz * z)
        )
        by_points[p, 1] += (
            rows[0, 1] * i
            + rows[1, 1] * j
            + by_cross[0, 1] * q
            + by_cross[1, 1] * r
            + share * (xy * x + yy * y + yz * z)
        )
        by_points[p, 2] += (
            rows[0, 2] * i
            + rows[1, 2] * j
            + by_cross[0, 2] * q
            + by_cross[1, 2] * r
            + share * (xz * x + yz * y + zz * z)
        )


@compiled
def _linear_back(camera: Camera, pull: float, slope: float, by: Gradients, by_turn: Floats) -> None:
    """Gradients through affine = inverse (cross + pull guess): add to cross and scatter."""
    by_rows, by_affine, by_cross, by_scatter = by.rows, by.affine, by.cross, by.scatter
    inverse, affine, guess = camera.inverse, camera.affine, camera.guess
    by_pull = 0.0
    for i in range(2):
        x, y, z = by_affine[i, 0], by_affine[i, 1], by_affine[i, 2]
        for j in range(3):
            by_rows[i, j] = inverse[j, 0] * x + inverse[j, 1] * y + inverse[j, 2] * z
            by_pull += by_rows[i, j] * guess[i, j]
            by_cross[i, j] += by_rows[i, j]
    by_variance = slope * by_pull
    for j in range(3):
        for k in range(3):
            by_inverse = by_rows[0, j] * affine[0, k] + by_rows[1, j] * affine[1, k]
            by_scatter[j, k] -= by_inverse
            if j == k:
                by_variance -= RIDGE * by_inverse
    for j in range(3):
        by_scatter[j, j] += by_variance
    for i in range(2):
        for j in range(3):
            by_rows[i, j] *= pull
    _nearest_back(guess, camera.polar[0], by_rows, by_turn)


@compiled
def _nearest_back(rows: Floats, polar: Floats, by_rows: Floats, out: Floats) -> None:
    """Gradient by M, of `_nearest`: dU = W U + T^-1 dM n n^T, W antisymmetric.

    T W + W T is the antisymmetric part of dM U^T, and for 2x2 it is W trace(T).
    """
    if polar[0] == 0.0:
        out[:] = 0
        return
    turn = first = second = 0.0
    for j in range(3):
        turn += by_rows[0, j] * rows[1, j] - by_rows[1, j] * rows[0, j]
        first += by_rows[0, j] * polar[4 + j]
        second += by_rows[1, j] * polar[4 + j]
    turn /= polar[0]
    x, y = polar[1] * first + polar[2] * second, polar[2] * first + polar[3] * second
    for j in range(3):
        out[0, j] = turn * rows[1, j] + x * polar[4 + j]
        out[1, j] = y * polar[4 + j] - turn * rows[0, j]


@compiled
def _normalise_back(normal: Floats, radius: float, by_normal: Floats, out: Floats) -> None:
    """Gradient by the points, of `normalise`."""
    count, width = normal.shape
    along = 0.0
    for p in range(count):
        for d in range(width):
            along += float(by_normal[p, d]) * normal[p, d]
    along /= count
    for d in range(width):
        mean = 0.0
        for p in range(count):
            mean += by_normal[p, d]
        mean /= count
        for p in range(count):
            out[p, d] = (by_normal[p, d] - mean - along * normal[p, d]) / radius


@compiled
def fill_back(
    weights: Floats, filled: Floats, sizes: Floats, by_filled: Floats, out: Floats
) -> None:
    """Write the gradient by the projections, of `models.network.reprojection_kernels.fill`."""
    for n in range(len(out)):
        for k in range(out.shape[1]):
            _normalise_back(filled[n, k], sizes[n, k], by_filled[n, k], out[n, k])
            for p in range(out.shape[2]):
                for d in range(2):
                    out[n, k, p, d] *= 1.0 - weights[n, k, p]
