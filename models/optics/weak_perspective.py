"""Weak-perspective cameras: the closed-form orthographic-n-point solution, compiled.

A camera takes a structure X to its own axes, x right, y down, z forward, by a rotation R. Weak
perspective then projects it to the image by `w = scale (R X)_xy + translation`; the scale is in
image units per unit of the structure.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import inverse_symmetric
from models.numerics.rotations import SymmetricFactor, nearest_orthonormal_rows_into
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Floats = NDArray[Any]  # of 32 or 64 bits

RIDGE = 1e-4  # share of the structure's variance: above float32 noise, below any real depth


class CameraSolution(NamedTuple):
    """The camera of one view, and the quantities that its gradients need."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (2,) image units
    structure_mean: Float64  # (3,) weighted
    image_mean: Float64  # (2,) weighted
    scatter: Float64  # (3, 3) weighted covariance of the structure
    cross: Float64  # (2, 3) weighted covariance of image and structure
    inverse: Float64  # (3, 3) of the scatter with its ridge
    affine: Float64  # (2, 3) least squares without the condition that rows are orthonormal


class CameraScale(NamedTuple):
    """The numbers of a `CameraSolution`."""

    scale: float  # image units per unit of the structure
    square: float  # mean squared length of what the camera sees at scale 1: divides the scale
    pull: float  # weight of the guess in the affine solution
    pull_slope: float  # derivative of the pull by the variance of the structure
    factor: SymmetricFactor  # of the affine solution


@compiled
def new_camera() -> CameraSolution:
    """Return unfilled arrays for `solve_camera_into`."""
    return CameraSolution(
        np.empty((3, 3)),
        np.empty(2),
        np.empty(3),
        np.empty(2),
        np.empty((3, 3)),
        np.empty((2, 3)),
        np.empty((3, 3)),
        np.empty((2, 3)),
    )


@inner
def solve_camera_into(
    points: Floats,
    image: Floats,
    weights: Floats,
    whole: float,
    guess: Float64,
    camera: CameraSolution,
) -> CameraScale:
    """Find the camera that projects `points` onto `image` with least weighted squared error.

    The orthographic-n-point problem with scale (paper, "Calculating R using solution from OnP"):
    solve the linear least squares w = M X for the 2x3 matrix M, take the nearest rotation, then
    the best scale and translation for it. The linear step inverts the 3x3 scatter of the structure,
    which fails for a flat one. A ridge towards `guess` (Tikhonov) decides those rotations that the
    points do not determine.

    Parameters
    ----------
    points, image, weights
        (P, 3) structure, (P, 2) keypoints and (P,) weights of at least 0. Keypoints without a
        weight may be any finite numbers.
    whole
        Sum of the weights, more than 0.
    guess
        A rotation (3, 3), or its first two rows.
    camera
        Its arrays are written.
    """
    spread = _moments_into(points, image, weights, whole, camera)
    scatter, cross = camera.scatter, camera.cross
    variance = scatter[0, 0] + scatter[1, 1] + scatter[2, 2] + TINY
    ridge = RIDGE * variance
    # A typical scale is enough for the guess: it matters only where points do not determine it.
    root = math.sqrt(spread / variance + TINY)
    pull = ridge * root
    pull_slope = RIDGE * (root - spread / (2.0 * variance * root))
    inverse_symmetric(scatter, ridge, camera.inverse)
    inverse, affine, rotation = camera.inverse, camera.affine, camera.rotation
    for i in range(2):
        x, y, z = (
            cross[i, 0] + pull * guess[i, 0],
            cross[i, 1] + pull * guess[i, 1],
            cross[i, 2] + pull * guess[i, 2],
        )
        for j in range(3):
            affine[i, j] = inverse[j, 0] * x + inverse[j, 1] * y + inverse[j, 2] * z
    factor = nearest_orthonormal_rows_into(affine, rotation)

    # The best scale for these rows is <cross, rows> / <rows scatter, rows>.
    overlap = square = 0.0
    for i in range(2):
        for j in range(3):
            overlap += cross[i, j] * rotation[i, j]
            square += rotation[i, j] * (
                scatter[j, 0] * rotation[i, 0]
                + scatter[j, 1] * rotation[i, 1]
                + scatter[j, 2] * rotation[i, 2]
            )
    square += TINY
    scale = overlap / square
    mean = camera.structure_mean
    for i in range(2):
        x, y, z = scale * rotation[i, 0], scale * rotation[i, 1], scale * rotation[i, 2]
        camera.translation[i] = camera.image_mean[i] - x * mean[0] - y * mean[1] - z * mean[2]
    return CameraScale(scale, square, pull, pull_slope, factor)


@inner
def _moments_into(
    points: Floats, image: Floats, weights: Floats, whole: float, camera: CameraSolution
) -> float:
    """Write weighted means and covariances of a structure and its image; the image's variance."""
    x_mean = y_mean = z_mean = u_mean = v_mean = 0.0
    for p in range(len(points)):
        share = weights[p] / whole
        x_mean += share * points[p, 0]
        y_mean += share * points[p, 1]
        z_mean += share * points[p, 2]
        u_mean += share * image[p, 0]
        v_mean += share * image[p, 1]
    mean, s, m = camera.structure_mean, camera.scatter, camera.cross
    mean[0], mean[1], mean[2] = x_mean, y_mean, z_mean
    camera.image_mean[0], camera.image_mean[1] = u_mean, v_mean
    xx = xy = xz = yy = yz = zz = 0.0
    xu = yu = zu = xv = yv = zv = spread = 0.0
    for p in range(len(points)):
        share = weights[p] / whole
        x, y, z = points[p, 0] - x_mean, points[p, 1] - y_mean, points[p, 2] - z_mean
        u, v = image[p, 0] - u_mean, image[p, 1] - v_mean
        sx, sy, sz = share * x, share * y, share * z
        xx += sx * x
        xy += sx * y
        xz += sx * z
        yy += sy * y
        yz += sy * z
        zz += sz * z
        xu += sx * u
        yu += sy * u
        zu += sz * u
        xv += sx * v
        yv += sy * v
        zv += sz * v
        spread += share * (u * u + v * v)
    s[0, 0], s[0, 1], s[0, 2] = xx, xy, xz
    s[1, 0], s[1, 1], s[1, 2] = xy, yy, yz
    s[2, 0], s[2, 1], s[2, 2] = xz, yz, zz
    m[0, 0], m[0, 1], m[0, 2] = xu, yu, zu
    m[1, 0], m[1, 1], m[1, 2] = xv, yv, zv
    return spread


@inner
def project_into(points: Floats, camera: CameraSolution, scale: float, out: Floats) -> None:
    """Write the projections (P, 2) of points (P, 3): w = scale (R X)_xy + translation, eq. 1."""
    rotation = camera.rotation
    for i in range(2):
        x, y, z = scale * rotation[i, 0], scale * rotation[i, 1], scale * rotation[i, 2]
        shift = camera.translation[i]
        for p in range(len(points)):
            out[p, i] = x * points[p, 0] + y * points[p, 1] + z * points[p, 2] + shift
