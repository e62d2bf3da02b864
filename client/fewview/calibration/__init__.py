"""Cameras with their poses, in calibration files and as estimated by a fit."""

from fewview.calibration.camera import Camera, from_model, rotation_matrix, rotation_vector
from fewview.calibration.comparing import CameraError, compare_cameras
from fewview.calibration.files import FORMATS, read_cameras, write_cameras
from fewview.calibration.given import as_config, for_views, read_for_views, sizes_for

__all__ = [
    "FORMATS",
    "Camera",
    "CameraError",
    "as_config",
    "compare_cameras",
    "for_views",
    "from_model",
    "read_cameras",
    "read_for_views",
    "rotation_matrix",
    "rotation_vector",
    "sizes_for",
    "write_cameras",
]
