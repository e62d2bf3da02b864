"""What a fit found out about the cameras."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class FoundCameras:
    """The K views of a fit; standard deviations are 0 for what was given and kept.

    Cameras at rest share one frame of reference: that of the first of them, or the one in which
    the user gave their poses.
    """

    arrangement: str  # "static", "moving" or "mixed"
    reason: str  # why, in words with figures
    warnings: tuple[str, ...]  # what does not fit, such as a calibration that is wrong
    fisheye: NDArray[np.bool_]  # (K,)
    focals: Float64  # (K, 2) pixels along x and y
    focal_sds: Float64  # (K,) pixels
    principal_points: Float64  # (K, 2) pixels
    principal_point_sds: Float64  # (K, 2) pixels
    distortions: Float64  # (K, 8) OpenCV's order
    distortion_sds: Float64  # (K,) of the first coefficient
    resting: NDArray[np.bool_]  # (K,)
    rotations: Float64  # (K, 3, 3) x_cam = R x + t; NaN for a view that does not rest
    rotation_sds: Float64  # (K,) degrees
    translations: Float64  # (K, 3) units of the structure; NaN for a view that does not rest
    translation_sds: Float64  # (K, 3)
    reprojection_errors: Float64  # (K,) pixels, mean over the frames it was found from
    noise: float  # pixels, standard deviation of a coordinate about the model
