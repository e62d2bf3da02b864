"""What the cameras of a file must be to be cameras; the service checks the same."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fewview.calibration.camera import Camera
from fewview.errors import FormatError

MOST_CAMERAS = 1000
LONGEST_NAME = 200
LONGEST_SIDE = 2**20  # pixels
LARGEST_FOCAL = 1e9  # pixels
ORTHONORMAL = 1e-3  # largest deviation of R R^T from 1 that rounding explains


def check(path: Path, cameras: list[Camera]) -> None:
    """Raise ``FormatError`` that names file, camera, field and remedy, for what no camera is."""
    if len(cameras) > MOST_CAMERAS:
        raise FormatError(f"{MOST_CAMERAS} cameras at most, it has {len(cameras)}", place=path)
    for camera in cameras:
        for fault in _faults(camera):
            raise FormatError(f"camera {camera.name[:LONGEST_NAME]!r}: {fault}", place=path)


def _faults(camera: Camera) -> Iterator[str]:
    """Yield what is wrong with a camera, and what it should be."""
    if len(camera.name) > LONGEST_NAME:
        yield f"name has {LONGEST_NAME} characters at most; shorten it"
    for field in ("matrix", "distortion", "rotation", "translation"):
        values = getattr(camera, field)
        if values is not None and not np.isfinite(values).all():
            yield f"{field} must be finite, got {values.ravel().tolist()}; calibrate it again"
    focal = (float(camera.matrix[0, 0]), float(camera.matrix[1, 1]))
    if not all(0 < each <= LARGEST_FOCAL for each in focal):
        yield f"focal lengths in matrix must be above 0 and in pixels, got {focal}"
    if camera.size is not None and not all(0 < side <= LONGEST_SIDE for side in camera.size):
        yield f"size must be from 1 to {LONGEST_SIDE} pixels, got {camera.size}"
    if camera.rotation is not None:
        off = float(np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max())
        if off > ORTHONORMAL:
            yield f"rotation must be orthonormal, R R^T is off by {off:.3g}; give it unrounded"
        if np.linalg.det(camera.rotation) < 0:
            yield "rotation must have determinant +1, it mirrors; the axes are OpenCV's"
