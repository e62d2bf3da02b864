"""Static cameras, their images of points, and the derivatives of these.

Coordinates of the images are pixels from the expected principal point in sides of the image; the
unit of the points is free. Points come last in all arrays.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.medians import median_of

Float64 = NDArray[np.float64]

CAMERA = 11  # numbers: log focal, principal point, radial coefficients, rotation, translation
LENS = 5
FREEDOM = 3.0  # of Student's t
NEAR, FAR = 0.2, 5.0  # median depths between which a point counts
TYPICAL = 128  # points that show it: twice as many at most
BLIND = 1.0  # sides: the distance of a point that a camera cannot see; the largest there is
# Places in a row of `Sight.cameras`.
FOCAL, CENTRE, BENDS, TURN, SHIFT, NUMBERS = 0, 1, 3, 5, 14, 17


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


class Sight(NamedTuple):
    """Cameras, points and keypoints as compiled functions take them: contiguous arrays."""

    cameras: Float64  # (K, 17) focal length, centre, radial coefficients, rotation, translation
    depths: Float64  # (K, 2) limits between which a point is visible
    points: Float64  # (3, M)
    images: Float64  # (K, 2, M)
    weights: Float64  # (K, M)


def sight_of(rig: StaticCameras, points: Float64, seen: SeenPoints) -> Sight:
    """Arrange cameras, points (3, M) and keypoints for compiled functions.

    A point is visible if its depth is usual among those that a camera sees.
    """
    views = len(rig.log_focals)
    cameras = np.empty((views, NUMBERS))
    cameras[:, FOCAL] = np.exp(rig.log_focals)
    cameras[:, CENTRE:BENDS], cameras[:, BENDS:TURN] = rig.centres, rig.radial
    cameras[:, TURN:SHIFT] = rig.rotations.reshape(views, -1)
    cameras[:, SHIFT:] = rig.translations
    points, images, weights = map(np.ascontiguousarray, (points, *seen))
    sight = Sight(cameras, np.empty((views, 2)), points, images, weights)
    _write_limits(sight, sight.depths)
    return sight


@compiled
def _write_limits(sight: Sight, out: Float64) -> None:
    """Write the depths (K, 2) between which a point counts; NaN if most are behind the camera.

    A sample of the points shows which depths are usual.
    """
    views, points = len(out), sight.points
    depths = np.empty(2 * TYPICAL)
    for k in range(views):
        camera, seen = sight.cameras[k], 0
        there = np.flatnonzero(sight.weights[k] > 0)
        for m in there[:: max(1, len(there) // TYPICAL)]:
            depth = _depth_of(camera, points[0, m], points[1, m], points[2, m])
            if math.isfinite(depth):
                depths[seen] = depth
                seen += 1
        median = median_of(depths[:seen]) if seen else 1.0
        out[k, 0], out[k, 1] = NEAR * median, FAR * median
        if median <= 0:
            out[k] = np.nan


@inner
def _depth_of(camera: Float64, x: float, y: float, z: float) -> float:
    return float(camera[11] * x + camera[12] * y + camera[13] * z + camera[16])


def distances_of(rig: StaticCameras, points: Float64, seen: SeenPoints) -> Float64:
    """Return distances (K, M) in sides from keypoints to projections; `BLIND` if not visible."""
    distances = np.empty(seen.weights.shape)
    _write_distances(sight_of(rig, points, seen), distances)
    return distances


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
    views, count = seen.weights.shape
    residuals = np.zeros((views, 2, count))
    by_camera, by_point = np.zeros((views, 2, CAMERA, count)), np.zeros((views, 2, 3, count))
    _linearise(sight_of(rig, points, seen), noise, residuals, by_camera, by_point)
    return residuals, by_camera, by_point


@inner
def image_of(sight: Sight, k: int, m: int, out: Float64) -> bool:
    """Project point m into view k; False if it is not visible there.

    Writes the image (2,), and after it the direction (2,) at depth one and the depth.
    """
    camera = sight.cameras[k]
    x, y, z = sight.points[0, m], sight.points[1, m], sight.points[2, m]
    depth = _depth_of(camera, x, y, z)
    if not (sight.depths[k, 0] < depth < sight.depths[k, 1]):
        return False
    a = (camera[5] * x + camera[6] * y + camera[7] * z + camera[14]) / depth
    b = (camera[8] * x + camera[9] * y + camera[10] * z + camera[15]) / depth
    squared = a * a + b * b
    scale = camera[0] * (1.0 + squared * (camera[3] + squared * camera[4]))
    out[0], out[1] = scale * a + camera[1], scale * b + camera[2]
    out[2], out[3], out[4] = a, b, depth
    return True


@inner
def differentiate_image(
    sight: Sight, k: int, seen: Float64, by_held: Float64, by_point: Float64
) -> None:
    """Write derivatives (2, 3) of an image by the point in the camera's frame, and in the rig's.

    `seen` is what `image_of` wrote.
    """
    camera = sight.cameras[k]
    a, b, depth = seen[2], seen[3], seen[4]
    squared = a * a + b * b
    gain = 1.0 + squared * (camera[3] + squared * camera[4])
    slope = 2.0 * camera[3] + 4.0 * camera[4] * squared
    focal = camera[0] / depth
    by_held[0, 0] = focal * (gain + slope * a * a)
    by_held[0, 1] = focal * slope * a * b
    by_held[1, 0] = by_held[0, 1]
    by_held[1, 1] = focal * (gain + slope * b * b)
    for i in range(2):
        by_held[i, 2] = -(by_held[i, 0] * a + by_held[i, 1] * b)
        for j in range(3):
            by_point[i, j] = (
                by_held[i, 0] * camera[5 + j]
                + by_held[i, 1] * camera[8 + j]
                + by_held[i, 2] * camera[11 + j]
            )


@inner
def distance_in(sight: Sight, k: int, m: int, seen: Float64) -> float:
    """Return the distance in view k of the image `seen`, which `image_of` wrote."""
    across, down = seen[0] - sight.images[k, 0, m], seen[1] - sight.images[k, 1, m]
    return min(math.sqrt(across * across + down * down), BLIND)


@compiled
def _write_distances(sight: Sight, out: Float64) -> None:
    views, count = out.shape
    seen = np.empty(5)
    for k in range(views):
        for m in range(count):
            visible = image_of(sight, k, m, seen)
            out[k, m] = distance_in(sight, k, m, seen) if visible else BLIND


@compiled
def _linearise(
    sight: Sight, noise: Float64, residuals: Float64, by_camera: Float64, by_point: Float64
) -> None:
    views, count = sight.weights.shape
    seen, of_held, of_point = np.empty(5), np.empty((2, 3)), np.empty((2, 3))
    for k in range(views):
        camera = sight.cameras[k]
        for m in range(count):
            if sight.weights[k, m] <= 0 or not image_of(sight, k, m, seen):
                continue
            differentiate_image(sight, k, seen, of_held, of_point)
            across, down = seen[0] - sight.images[k, 0, m], seen[1] - sight.images[k, 1, m]
            squared = (across * across + down * down) / noise[k] ** 2
            root = math.sqrt(sight.weights[k, m] * (FREEDOM + 2) / (FREEDOM + squared)) / noise[k]
            residuals[k, 0, m], residuals[k, 1, m] = root * across, root * down
            turned = (
                seen[2] * seen[4] - camera[14],
                seen[3] * seen[4] - camera[15],
                seen[4] - camera[16],
            )
            bend = seen[2] ** 2 + seen[3] ** 2
            gain = 1.0 + bend * (camera[3] + bend * camera[4])
            for i in range(2):
                along = root * camera[0] * seen[2 + i]
                by_camera[k, i, 0, m] = gain * along
                by_camera[k, i, 1 + i, m] = root
                by_camera[k, i, 3, m] = bend * along
                by_camera[k, i, 4, m] = bend * bend * along
                x, y, z = root * of_held[i, 0], root * of_held[i, 1], root * of_held[i, 2]
                by_camera[k, i, LENS, m] = turned[1] * z - turned[2] * y
                by_camera[k, i, LENS + 1, m] = turned[2] * x - turned[0] * z
                by_camera[k, i, LENS + 2, m] = turned[0] * y - turned[1] * x
                by_camera[k, i, LENS + 3, m] = x
                by_camera[k, i, LENS + 4, m] = y
                by_camera[k, i, LENS + 5, m] = z
                for j in range(3):
                    by_point[k, i, j, m] = root * of_point[i, j]
