"""Compiled geometry of a training step; gradients are in `reprojection_gradients`."""

import numpy as np

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import total
from models.numerics.normalisation import normalise_into
from models.numerics.rotations import Floats, nearest_orthonormal_rows_into
from models.optics.weak_perspective import new_camera, project_into, solve_camera_into


@compiled
def reproject(
    points: Floats,
    normal: Floats,
    matrices: Floats,
    keypoints: Floats,
    weights: Floats,
    projected: Floats,
) -> None:
    """Compute the results of `models.network.reprojection.reproject`.

    Parameters
    ----------
    points, matrices, keypoints, weights
        (N, P, 3), (N, K, 2, 3), (N, K, P, 2) and (N, K, P), as that function takes them.
    normal, projected
        (N, P, 3) and (N, K, P, 2) are written.
    """
    camera = new_camera()
    guess = np.empty((3, 3))
    for n in range(len(points)):
        normalise_into(points[n], normal[n])
        for k in range(matrices.shape[1]):
            whole = total(weights[n, k])
            if whole > 0:
                nearest_orthonormal_rows_into(matrices[n, k], guess)
                scale = solve_camera_into(
                    normal[n], keypoints[n, k], weights[n, k], whole, guess, camera
                ).scale
                project_into(normal[n], camera, scale, projected[n, k])
            else:
                projected[n, k] = 0


@compiled
def fill(
    projected: Floats, keypoints: Floats, weights: Floats, filled: Floats, sizes: Floats
) -> None:
    """Compute the results of `models.network.reprojection.fill`, and the sizes of the views.

    Parameters
    ----------
    projected, keypoints, weights
        (N, K, P, 2), (N, K, P, 2) and (N, K, P), as that function takes them.
    filled, sizes
        (N, K, P, 2) and (N, K) are written.
    """
    mixed = np.empty(projected.shape[2:])  # (P, 2)
    for n in range(len(projected)):
        for k in range(projected.shape[1]):
            sizes[n, k] = fill_view_into(
                projected[n, k], keypoints[n, k], weights[n, k], mixed, filled[n, k]
            )


@inner
def fill_view_into(
    projected: Floats, keypoints: Floats, weights: Floats, mixed: Floats, filled: Floats
) -> float:
    """Mix a view (P, 2) with its reprojection by the weights (P,), and normalise it.

    Returns the size it had before.

    `mixed` (P, 2) is a buffer, and may be `filled`.
    """
    for p in range(len(weights)):
        weight = weights[p]
        for d in range(2):
            seen, hidden = keypoints[p, d], projected[p, d]
            mixed[p, d] = weight * seen + (1.0 - weight) * hidden
    return normalise_into(mixed, filled)
