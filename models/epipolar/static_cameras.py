"""Static cameras, their images of points, and the derivatives of these.

Coordinates of the images are pixels from the expected principal point in sides of the image; the
unit of the points is free. Points come last in all arrays, so that everything runs along them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

CAMERA = 11  # numbers: log focal, principal point, radial coefficients, rotation, translation
LENS = 5
FREEDOM = 3.0  # of Student's t
NEAR, FAR = 0.2, 5.0  # median depths between which a point counts
BLIND = 1.0  # sides: the distance of a point that a camera cannot see; the largest there is


class StaticCameras(NamedTuple):
    """K static cameras, x = R X + t, and their lenses in sides of the image."""

    log_focals: Float64  # (K,)
    centres: Float64  # (K, 2) from the expected principal points
    radial: Float64  # (K, 2) first two radial coefficients
    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)

    def of(self, views: list[int]) -> "StaticCameras":
        """Return some of the cameras."""
        return StaticCameras(*(array[views] for array in self))


class SeenPoints(NamedTuple):
    """The images of M points in K cameras."""

    images: Float64  # (K, 2, M), any finite number where the weight is 0
    weights: Float64  # (K, M) confidences


def images_of(rig: StaticCameras, points: Float64, seen: SeenPoints) -> tuple[Float64, Bool]:
    """Return images (K, 2, M) of points (3, M), and whether (K, M) they are visible there."""
    flat, visible = _flat(rig.rotations @ points + rig.translations[..., None], seen)
    return _images(rig, flat)[0], visible


def distances_of(rig: StaticCameras, points: Float64, seen: SeenPoints) -> Float64:
    """Return distances (K, M) in sides from keypoints to projections; `BLIND` if not visible."""
    images, visible = images_of(rig, points, seen)
    lengths = np.linalg.norm(images - seen.images, axis=1)
    distances: Float64 = np.where(visible, np.minimum(lengths, BLIND), BLIND)
    return distances


def robust_costs(distances: Float64, weights: Float64, noise: Float64) -> Float64:
    """Minus log likelihood (K, M) of distances (K, M) under Student's t of `noise` (K,)."""
    squared = np.square(distances / noise[:, None]) / FREEDOM
    costs: Float64 = weights * ((FREEDOM + 2) / 2 * np.log1p(squared) + 2 * np.log(noise)[:, None])
    return costs


def rays_of(rig: StaticCameras, images: Float64) -> Float64:
    """Return unit directions (K, 3, M) in the rig's frame; the lens is undone by iteration."""
    flat = (images - rig.centres[..., None]) / np.exp(rig.log_focals)[:, None, None]
    straight = flat
    for _ in range(4):
        squared = np.square(straight).sum(1, keepdims=True)
        bent = 1 + squared * (rig.radial[:, :1, None] + squared * rig.radial[:, 1:, None])
        straight = flat / bent.clip(0.3, 3)
    rays = np.concatenate((straight, np.ones_like(straight[:, :1])), 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned: Float64 = rig.rotations.mT @ rays
    return turned


def linearised(
    rig: StaticCameras, points: Float64, seen: SeenPoints, noise: Float64
) -> tuple[Float64, Float64, Float64]:
    """Return weighted residuals (K, 2, M), and derivatives by cameras and points.

    These are (K, 2, 11, M) and (K, 2, 3, M).
    """
    turned = rig.rotations @ points
    camera = turned + rig.translations[..., None]
    flat, visible = _flat(camera, seen)
    images, gain, squared = _images(rig, flat)
    residuals = images - seen.images
    lengths = np.square(residuals).sum(1) / np.square(noise)[:, None]
    weights = seen.weights * visible * (FREEDOM + 2) / (FREEDOM + lengths)
    root = np.sqrt(weights) / noise[:, None]  # (K, M)
    focals = np.exp(rig.log_focals)[:, None]
    views, count = root.shape
    depths = np.where(visible, camera[:, 2], 1.0)
    by_camera = np.zeros((views, 2, CAMERA, count))
    by_camera[:, :, 0] = focals[..., None] * gain[:, None] * flat
    by_camera[:, 0, 1] = by_camera[:, 1, 2] = 1
    by_camera[:, :, 3] = focals[..., None] * squared[:, None] * flat
    by_camera[:, :, 4] = squared[:, None] * by_camera[:, :, 3]
    by_held = _by_held(rig, flat, depths)
    by_camera[:, :, LENS + 3 :] = by_held
    by_camera[:, :, LENS : LENS + 3] = np.cross(turned[:, None], by_held, axis=2)
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations, optimize=True)
    return (
        residuals * root[:, None],
        by_camera * root[:, None, None],
        by_point * root[:, None, None],
    )


def residuals_by_points(
    rig: StaticCameras, points: Float64, seen: SeenPoints
) -> tuple[Float64, Float64]:
    """Return residuals (K, 2, M) of points (3, M) in sides, and their derivatives (K, 2, 3, M).

    Both are 0 where a camera cannot see the point.
    """
    camera = rig.rotations @ points + rig.translations[..., None]
    flat, visible = _flat(camera, seen)
    images, _, _ = _images(rig, flat)
    by_held = _by_held(rig, flat, np.where(visible, camera[:, 2], 1.0))
    by_point = np.einsum("kiam,kab->kibm", by_held, rig.rotations, optimize=True)
    there = (visible & (seen.weights > 0))[:, None]
    return np.where(there, images - seen.images, 0.0), by_point * there[:, None]


def _flat(camera: Float64, seen: SeenPoints) -> tuple[Float64, Bool]:
    """Directions (K, 2, M) at depth one, and whether the points have a usual depth (K, M)."""
    depths = camera[:, 2]
    there = seen.weights > 0
    medians = np.array(
        [np.median(row[w]) if w.any() else 1.0 for row, w in zip(depths, there, strict=True)]
    )[:, None]
    visible: Bool = (depths > NEAR * medians) & (depths < FAR * medians) & (medians > 0)
    safe = np.where(visible, depths, 1.0)
    return camera[:, :2] / safe[:, None], visible


def _images(rig: StaticCameras, flat: Float64) -> tuple[Float64, Float64, Float64]:
    """Images (K, 2, M) of directions (K, 2, M), the lens's gain and the squared radius (K, M)."""
    squared = np.square(flat).sum(1)
    gain = 1 + squared * (rig.radial[:, :1] + squared * rig.radial[:, 1:])
    images = np.exp(rig.log_focals)[:, None, None] * gain[:, None] * flat
    return images + rig.centres[..., None], gain, squared


def _by_held(rig: StaticCameras, flat: Float64, depths: Float64) -> Float64:
    """Return derivatives (K, 2, 3, M) of images by points in their camera's frame."""
    views, _, count = flat.shape
    focals = np.exp(rig.log_focals)[:, None]
    squared = np.square(flat).sum(1)
    gain = 1 + squared * (rig.radial[:, :1] + squared * rig.radial[:, 1:])
    slope = 2 * rig.radial[:, :1] + 4 * rig.radial[:, 1:] * squared
    by_flat = np.empty((views, 2, 2, count))
    a, b = flat[:, 0], flat[:, 1]
    by_flat[:, 0, 0] = focals * (gain + slope * a * a)
    by_flat[:, 0, 1] = by_flat[:, 1, 0] = focals * slope * a * b
    by_flat[:, 1, 1] = focals * (gain + slope * b * b)
    by_flat /= depths[:, None, None]
    return np.concatenate((by_flat, -(by_flat * flat[:, None]).sum(2, keepdims=True)), 2)
