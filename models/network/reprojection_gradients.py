"""Gradients of the compiled geometry of a training step, derived by hand.

`by_x` is the gradient of the loss with respect to x. Every function takes the gradients with
respect to the results of a function of the step, and computes those with respect to its arguments.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import total
from models.numerics.normalisation import normalise_into
from models.numerics.rotations import Floats, SymmetricFactor, nearest_orthonormal_rows_into
from models.optics.weak_perspective import (
    RIDGE,
    CameraScale,
    CameraSolution,
    new_camera,
    solve_camera_into,
)

Float64 = NDArray[np.float64]


class CameraGradients(NamedTuple):
    """Gradients with respect to the fields of `models.optics.weak_perspective.CameraSolution`."""

    rows: Float64  # (2, 3) of the rotation
    affine: Float64  # (2, 3)
    cross: Float64  # (2, 3)
    scatter: Float64  # (3, 3)


@compiled
def reproject_back(
    points: Floats,
    normal: Floats,
    matrices: Floats,
    keypoints: Floats,
    weights: Floats,
    by_normal: Floats,
    by_projected: Floats,
    by_points: Floats,
    by_matrices: Floats,
) -> None:
    """Write the gradients of `models.network.reprojection_kernels.reproject`.

    Parameters
    ----------
    points, normal, matrices, keypoints, weights
        Its arguments, and the normalised structures (N, P, 3) that it wrote.
    by_normal, by_projected
        (N, P, 3) and (N, K, P, 2), with respect to its results.
    by_points, by_matrices
        (N, P, 3) and (N, K, 2, 3) are written.
    """
    camera = new_camera()
    guess = np.empty((3, 3))
    buffer = np.empty_like(normal[0])
    summed = np.empty(normal[0].shape)  # (P, 3) gradient by the normalised structure
    by = CameraGradients(np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((3, 3)))
    for n in range(len(points)):
        radius = normalise_into(points[n], buffer)
        summed[:] = by_normal[n]
        for k in range(matrices.shape[1]):
            whole = total(weights[n, k])
            if whole > 0:
                guess_factor = nearest_orthonormal_rows_into(matrices[n, k], guess)
                solved = solve_camera_into(
                    normal[n], keypoints[n, k], weights[n, k], whole, guess, camera
                )
                _projection_back(normal[n], camera, solved, by_projected[n, k], by)
                _affine_back(camera, solved, guess, by)  # by.rows is now by the guess
                _nearest_rows_back(guess, guess_factor, by.rows, by_matrices[n, k])
                _moments_back(
                    normal[n],
                    keypoints[n, k],
                    weights[n, k],
                    whole,
                    camera,
                    solved.scale,
                    by_projected[n, k],
                    by,
                    summed,
                )
            else:
                by_matrices[n, k] = 0
        _normalise_back(normal[n], radius, summed, by_points[n])


@inner
def _projection_back(
    points: Floats,
    camera: CameraSolution,
    solved: CameraScale,
    by_projected: Floats,
    by: CameraGradients,
) -> None:
    """Write gradients by affine, cross and scatter, of w = scale rows (X - mean) + constant."""
    mean, scatter, cross, rows = (
        camera.structure_mean,
        camera.scatter,
        camera.cross,
        camera.rotation,
    )
    xu = yu = zu = xv = yv = zv = 0.0
    for p in range(len(points)):
        x, y, z = points[p, 0] - mean[0], points[p, 1] - mean[1], points[p, 2] - mean[2]
        by_u, by_v = by_projected[p, 0], by_projected[p, 1]
        xu += by_u * x
        yu += by_u * y
        zu += by_u * z
        xv += by_v * x
        yv += by_v * y
        zv += by_v * z
    by.rows[0, 0], by.rows[0, 1], by.rows[0, 2] = xu, yu, zu
    by.rows[1, 0], by.rows[1, 1], by.rows[1, 2] = xv, yv, zv
    by_scale = 0.0
    for i in range(2):
        for j in range(3):
            by_scale += by.rows[i, j] * rows[i, j]
    # scale = <cross, rows> / <rows, rows scatter>
    by_overlap = by_scale / solved.square
    by_square = -by_overlap * solved.scale
    for j in range(3):
        for k in range(3):
            by.scatter[j, k] = by_square * (rows[0, j] * rows[0, k] + rows[1, j] * rows[1, k])
    for i in range(2):
        for j in range(3):
            scattered = (
                scatter[j, 0] * rows[i, 0] + scatter[j, 1] * rows[i, 1] + scatter[j, 2] * rows[i, 2]
            )
            by.rows[i, j] = (
                solved.scale * by.rows[i, j] + by_overlap * cross[i, j] + 2 * by_square * scattered
            )
            by.cross[i, j] = by_overlap * rows[i, j]
    _nearest_rows_back(rows, solved.factor, by.rows, by.affine)


@inner
def _affine_back(
    camera: CameraSolution, solved: CameraScale, guess: Float64, by: CameraGradients
) -> None:
    """Go back through affine = inverse (cross + pull guess).

    Adds to the gradients by cross and scatter, and writes that by the guess in place of `by.rows`.
    """
    inverse, affine = camera.inverse, camera.affine
    by_pull = 0.0
    for i in range(2):
        x, y, z = by.affine[i, 0], by.affine[i, 1], by.affine[i, 2]
        for j in range(3):
            by.rows[i, j] = inverse[j, 0] * x + inverse[j, 1] * y + inverse[j, 2] * z
            by_pull += by.rows[i, j] * guess[i, j]
            by.cross[i, j] += by.rows[i, j]
    by_variance = solved.pull_slope * by_pull
    for j in range(3):
        for k in range(3):
            by_inverse = by.rows[0, j] * affine[0, k] + by.rows[1, j] * affine[1, k]
            by.scatter[j, k] -= by_inverse
            if j == k:
                by_variance -= RIDGE * by_inverse
    for j in range(3):
        by.scatter[j, j] += by_variance
    for i in range(2):
        for j in range(3):
            by.rows[i, j] *= solved.pull


@inner
def _moments_back(
    points: Floats,
    image: Floats,
    weights: Floats,
    whole: float,
    camera: CameraSolution,
    scale: float,
    by_projected: Floats,
    by: CameraGradients,
    by_points: Float64,
) -> None:
    """Add the gradient by the points (P, 3) of one view: directly, by cross and by scatter.

    With shares s = weight / whole, cross = sum s (w - mean) (X - mean)^T and
    scatter = sum s (X - mean) (X - mean)^T.
    """
    rows, by_cross, g = camera.rotation, by.cross, by.scatter
    for j in range(3):
        for k in range(j + 1):
            g[j, k] += g[k, j]  # the scatter is symmetric; on the diagonal this doubles
            g[k, j] = g[j, k]
    by_u_sum = by_v_sum = 0.0
    for p in range(len(points)):
        by_u_sum += by_projected[p, 0]
        by_v_sum += by_projected[p, 1]
    mean, image_mean = camera.structure_mean, camera.image_mean
    for p in range(len(points)):
        share = weights[p] / whole
        x, y, z = points[p, 0] - mean[0], points[p, 1] - mean[1], points[p, 2] - mean[2]
        by_u = scale * (by_projected[p, 0] - share * by_u_sum)
        by_v = scale * (by_projected[p, 1] - share * by_v_sum)
        u, v = share * (image[p, 0] - image_mean[0]), share * (image[p, 1] - image_mean[1])
        for j in range(3):
            by_points[p, j] += (
                rows[0, j] * by_u
                + rows[1, j] * by_v
                + by_cross[0, j] * u
                + by_cross[1, j] * v
                + share * (g[j, 0] * x + g[j, 1] * y + g[j, 2] * z)
            )


@inner
def _nearest_rows_back(
    rotation: Float64, factor: SymmetricFactor, by_rows: Floats, by_matrix: Floats
) -> None:
    """Write the gradient by M (2, 3) of its nearest orthonormal rows U, with M = T U.

    dU = W U + T^-1 dM n n^T, where n is the third row of the rotation and W is antisymmetric.
    T W + W T is the antisymmetric part of dM U^T, and for 2x2 it is W trace(T).
    """
    if not factor.unique:
        by_matrix[:] = 0
        return
    by_angle = first = second = 0.0
    for j in range(3):
        by_angle += by_rows[0, j] * rotation[1, j] - by_rows[1, j] * rotation[0, j]
        first += by_rows[0, j] * rotation[2, j]
        second += by_rows[1, j] * rotation[2, j]
    by_angle /= factor.trace
    x = factor.inverse_xx * first + factor.inverse_xy * second
    y = factor.inverse_xy * first + factor.inverse_yy * second
    for j in range(3):
        by_matrix[0, j] = by_angle * rotation[1, j] + x * rotation[2, j]
        by_matrix[1, j] = y * rotation[2, j] - by_angle * rotation[0, j]


@inner
def _normalise_back(normal: Floats, radius: float, by_normal: Floats, by_points: Floats) -> None:
    """Write the gradient by the points, of `models.numerics.normalisation.normalise_into`."""
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
            by_points[p, d] = (by_normal[p, d] - mean - along * normal[p, d]) / radius


@compiled
def fill_back(
    weights: Floats, filled: Floats, sizes: Floats, by_filled: Floats, by_projected: Floats
) -> None:
    """Write the gradient by the projections, of `models.network.reprojection_kernels.fill`.

    Parameters
    ----------
    weights, filled, sizes
        (N, K, P), (N, K, P, 2) and (N, K): its argument and its results.
    by_filled
        (N, K, P, 2).
    by_projected
        (N, K, P, 2) is written.
    """
    frames, views, count, _ = by_projected.shape
    for n in range(frames):
        for k in range(views):
            _normalise_back(filled[n, k], sizes[n, k], by_filled[n, k], by_projected[n, k])
            for p in range(count):
                for d in range(2):
                    by_projected[n, k, p, d] *= 1.0 - weights[n, k, p]
