"""Cameras with their places, as calibration files say them and as a fit found them."""

from fewview.calibration.camera import Camera, from_model, rotation_matrix, rotation_vector
from fewview.calibration.comparing import CameraError, compare_cameras
from fewview.calibration.files import FORMATS, read_cameras, write_cameras
from fewview.calibration.told import as_config, for_views, read_for_views, sizes_in

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
    "sizes_in",
    "write_cameras",
]
