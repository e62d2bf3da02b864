"""Rigs from cameras without perspective, as starts of rigs with it.

From far away two views fit a whole family of relative poses (Koenderink and van Doorn, *Affine
structure from motion*, 1991), so a rig that begins with one pair rarely fits the other views. Three
views or more determine all cameras at once, up to the mirror image.
"""

import numpy as np
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from models.numerics.rotations import nearest_rotations

Float64 = NDArray[np.float64]

LEAST_VIEWS, LEAST_POINTS = 3, 30  # points that all views see
ROUNDS = 8  # of reweighting points
FAR = 4.0  # times the expected focal lengths: the start for lenses that are not given
TINY = 1e-6  # of the largest eigenvalue of the metric, below which views do not determine it
MIRROR = np.diag([1.0, 1.0, -1.0])


def affine_rigs(seen: SeenPoints, beliefs: Beliefs) -> list[StaticCameras]:
    """Return a rig from scaled orthographic cameras, and its mirror image.

    The list is empty if there are two views, or too few points that all of them see, or if views
    share their axis. Images are factorised into cameras and points (Poelman and Kanade, *A
    paraperspective factorization method for shape and motion recovery*, 1997).
    """
    complete = (seen.weights > 0).all(0)
    if len(seen.weights) < LEAST_VIEWS or complete.sum() < LEAST_POINTS:
        return []
    axes, centres = _factorised(seen.images[..., complete])
    lengths = np.linalg.norm(axes, axis=(1, 2), keepdims=True)
    to_metric = _to_metric(axes / lengths) if lengths.all() else None
    if to_metric is None:
        return []
    axes = axes @ to_metric  # (K, 2, 3)
    scales = np.linalg.norm(axes, axis=2).mean(1)
    turns = np.concatenate((axes, np.cross(axes[:, :1], axes[:, 1:]) / scales[:, None, None]), 1)
    rotations = nearest_rotations(turns)
    focals = np.where(beliefs.focal_sds > 0, FAR, 1.0) * beliefs.focals
    rays = np.concatenate((centres / focals[:, None], np.ones((len(focals), 1))), 1)
    none = np.zeros((len(focals), 2))
    rig = StaticCameras(np.log(focals), none, none, rotations, rays * (focals / scales)[:, None])
    return [rig, rig._replace(rotations=MIRROR @ rotations @ MIRROR)]


def _factorised(images: Float64) -> tuple[Float64, Float64]:
    """Return axes (K, 2, 3), up to a linear map, and centres (K, 2) of images (K, 2, M).

    x = A X + c by robust least squares of rank three; points X have unit covariance.
    """
    views, _, count = images.shape
    rows = images.reshape(2 * views, count)
    weights = np.ones(count)
    for _ in range(ROUNDS):
        centre = (rows * weights).sum(1, keepdims=True) / weights.sum()
        centred = rows - centre
        basis, lengths, _ = np.linalg.svd(centred * np.sqrt(weights), full_matrices=False)
        basis = basis[:, :3]
        errors = np.square(centred - basis @ (basis.T @ centred)).sum(0)
        weights = 1 / (1 + errors / max(float(np.median(errors)), 1e-30))
    axes = basis * lengths[:3] / np.sqrt(weights.sum())
    return axes.reshape(views, 2, 3), centre.reshape(views, 2)


def _to_metric(axes: Float64) -> Float64 | None:
    """Return the map (3, 3) that makes both axes (K, 2, 3) of each view equally long and square.

    None if no map does.
    """
    across, down = axes.transpose(1, 0, 2)
    equal = _products(across, across) - _products(down, down)
    sizes = (_products(across, across) + _products(down, down)).sum(0, keepdims=True)
    equations = np.concatenate((equal, _products(across, down), sizes))
    right = np.zeros(len(equations))
    right[-1] = len(axes)
    a, b, c, d, e, f = np.linalg.lstsq(equations, right, rcond=None)[0]
    values, vectors = np.linalg.eigh(np.array([[a, b, c], [b, d, e], [c, e, f]]))
    if values[0] < TINY * values[2]:
        return None
    return np.asarray(vectors * np.sqrt(values), np.float64)


def _products(x: Float64, y: Float64) -> Float64:
    """Return the coefficients (K, 6) of x' Q y in the upper triangle of a symmetric Q."""
    i, j = np.triu_indices(3)
    both = x[:, i] * y[:, j] + x[:, j] * y[:, i]
    return np.asarray(np.where(i == j, both / 2, both))
