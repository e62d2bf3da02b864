"""The result of a self-calibration: for the library, and as a report for people."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import CENTRE_X, FOCAL, LENS, RADIAL, Rig
from models.bundle.shape_model import NetworkErrors, ShapeModel
from models.findings.finding import Finding
from models.network.settling import SettlingPolicy
from models.optics.lenses.projection import LENSES

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class SelfCalibration:
    """The K cameras of a fit, its shapes, and the errors of its network."""

    rig: Rig
    # (K, 11) standard deviations of the numbers of `models.bundle.problem.VIEW`; 0 if held.
    deviations: Float64
    shapes: ShapeModel
    network_errors: NetworkErrors
    settling: SettlingPolicy  # which frames of a lift are settled
    noise: float  # pixels, standard deviation of a coordinate of confidence 1
    unit: float  # a unit of the structure in the user's unit; 1 without one
    reprojection_errors: Float64  # (K,) pixels, mean
    reason: str  # why the cameras are static or moving, in words with figures
    findings: tuple[Finding, ...] = ()  # such as a calibration that disagrees
    # Certainty, 0 to 1, that structures are no mirror images; NaN: unknown (older files).
    handedness_certainty: float = math.nan

    @property
    def static(self) -> NDArray[np.bool_]:
        """Which views (K,) are static relative to another."""
        return self.rig.static


@dataclass(frozen=True)
class CameraReport:
    """The K views of a fit; standard deviations are 0 for given numbers that were held.

    Static cameras share one frame of reference: that of the first of them, or the one in which the
    user gave their poses.
    """

    arrangement: str  # "static", "moving" or "mixed"
    reason: str  # why, in words with figures
    findings: tuple[Finding, ...]  # such as a calibration that disagrees
    camera_models: tuple[str, ...]  # K of `models.lifting.lift.CAMERA_MODELS`
    focals: Float64  # (K, 2) pixels along x and y
    focal_sds: Float64  # (K,) pixels
    principal_points: Float64  # (K, 2) pixels
    principal_point_sds: Float64  # (K, 2) pixels
    distortions: Float64  # (K, 8) OpenCV's order
    distortion_sds: Float64  # (K, 2) of the first two coefficients
    static: NDArray[np.bool_]  # (K,)
    rotations: Float64  # (K, 3, 3) x_cam = R x + t; NaN for a moving view
    rotation_sds: Float64  # (K,) degrees
    translations: Float64  # (K, 3) units of the structure; NaN for a moving view
    translation_sds: Float64  # (K, 3)
    reprojection_errors: Float64  # (K,) pixels, mean over the frames it was estimated from
    noise: float  # pixels, standard deviation of a coordinate about the model
    handedness_certainty: float  # 0 to 1; NaN from older versions


def camera_report(calibration: SelfCalibration) -> CameraReport:
    """Return the cameras as a report, in the units of the user."""
    rig, deviations = calibration.rig, calibration.deviations
    lenses, static, unit = rig.lenses, rig.static, calibration.unit
    arrangement = "static" if static.all() else "mixed" if static.any() else "moving"
    rotation_sds = np.degrees(np.linalg.norm(deviations[:, LENS : LENS + 3], axis=-1))

    def of_static(values: Float64) -> Float64:
        there = static.reshape(-1, *[1] * (values.ndim - 1))
        return np.where(there, values, np.nan)

    return CameraReport(
        arrangement=arrangement,
        reason=calibration.reason,
        findings=calibration.findings,
        camera_models=tuple(LENSES[model].LIFTED_AS for model in lenses.models),
        focals=lenses.focals.copy(),
        focal_sds=deviations[:, FOCAL] * lenses.focals.mean(-1),
        principal_points=lenses.centres.copy(),
        principal_point_sds=deviations[:, CENTRE_X:RADIAL].copy(),
        distortions=lenses.distortion.copy(),
        distortion_sds=deviations[:, RADIAL:LENS].copy(),
        static=static,
        rotations=of_static(rig.rotations),
        rotation_sds=of_static(rotation_sds),
        translations=of_static(unit * rig.translations),
        translation_sds=of_static(unit * deviations[:, LENS + 3 :]),
        reprojection_errors=calibration.reprojection_errors.copy(),
        noise=calibration.noise,
        handedness_certainty=calibration.handedness_certainty,
    )
