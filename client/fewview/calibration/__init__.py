"""Cameras with their places, as calibration files say them and as a fit found them."""

from fewview.calibration.camera import Camera, rotation_matrix, rotation_vector

__all__ = ["Camera", "rotation_matrix", "rotation_vector"]
