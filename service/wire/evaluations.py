"""Figures of structures and cameras against a truth; the client has the arithmetic."""

from collections.abc import Sequence
from typing import Self

import numpy as np
from fewview.calibration import Camera, compare_cameras, from_model, rotation_matrix
from fewview.evaluation import evaluate
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from models.capture.triangulation import triangulate
from models.settings.calibration import Camera as ToldCamera
from service.wire.cameras import ModelCameras

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Cameras = Sequence[Camera]


class Figures(BaseModel):
    """Errors of structures; null where nothing is known."""

    frames: int = Field(description="Frames that were compared: with three keypoints or more.")
    pa_mpjpe: float = Field(
        description="Mean error once every frame was aligned alone, by place, size and rotation."
    )
    mpjpe: float = Field(
        description="Mean error once all frames were aligned together, by one similarity."
    )
    pck: list[float] = Field(
        description="Shares of keypoints, each frame aligned alone, within each of `thresholds`."
    )
    thresholds: list[float]
    auc: float = Field(description="Area under that curve, as a share of the whole.")
    per_keypoint: list[float | None] = Field(description="`pa_mpjpe` of each keypoint.")
    per_frame: list[float | None] = Field(description="`pa_mpjpe` of each frame.")
    mirrored: bool = Field(description="Whether the mirror image was taken, which must be asked.")

    @classmethod
    def of(
        cls, points: Float32 | Float64, truth: Float32, reach: float | None, *, mirrored_too: bool
    ) -> Self:
        """Measure structures (N, P, 3) against a truth (N, P, 3); raises as ``evaluate`` does."""
        found = evaluate(points, truth, reach=reach, mirrored_too=mirrored_too)
        return cls.model_validate(found.plain())


class CameraFigures(BaseModel):
    """How far a camera is from its calibration, once both rigs are aligned by a similarity."""

    view: int
    rotation: float | None = Field(description="Degrees; null where the camera moves.")
    direction: float | None = Field(
        description="Degrees between the directions from the middle of all cameras to this one."
    )
    centre: float | None = Field(description="Distance of the centres, the calibration's unit.")
    focal: tuple[float, float] = Field(description="Per cent too long, along x and y.")
    principal_point: float = Field(description="Distance in pixels.")

    @classmethod
    def compare(cls, found: Cameras, entries: Sequence[ToldCamera | None]) -> list[Self]:
        """Compare the cameras of the views with a calibration; ``ValueError`` if it has others."""
        errors = [error.plain() for error in compare_cameras(found, calibrated(entries))]
        shown = cls.model_fields.keys() - {"view"}
        return [
            cls(view=view, **{name: error[name] for name in shown})
            for view, error in enumerate(errors)
        ]


class Evaluation(Figures):
    """Figures of structures, and of what was asked for beside them."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "frames": 2,
                "pa_mpjpe": 0.031,
                "mpjpe": 0.044,
                "pck": [0.0, 0.7, 1.0],
                "thresholds": [0.0, 0.05, 0.1],
                "auc": 0.6,
                "per_keypoint": [0.02, 0.03, 0.04, None],
                "per_frame": [0.03, 0.032],
                "mirrored": False,
                "keypoint_names": ["nose", "neck", "elbow", "wrist"],
                "cameras": None,
                "triangulation": None,
            }
        }
    )

    keypoint_names: list[str] | None
    cameras: list[CameraFigures] | None = Field(
        description="Those of the fit against `calibration`; null if none was given."
    )
    triangulation: Figures | None = Field(
        description="The same figures of the dataset's keypoints, triangulated (TRNG)."
    )


def found_cameras(found: ModelCameras) -> Cameras:
    """Return the cameras that a fit found; ``ValueError`` if they are weak perspective."""
    return from_model(found.model_dump())


def calibrated(entries: Sequence[ToldCamera | None]) -> Cameras:
    """Return the cameras of a calibration as objects of the client.

    Raises
    ------
    ValueError
        If a lens is not given completely.
    """
    cameras = []
    for view, entry in enumerate(entries):
        lens = None if entry is None else entry.intrinsics
        if entry is None or lens is None or lens.centre is None:
            raise ValueError(f"expected the whole lens of view {view}: fx, cx and cy at least")
        (fx, fy), (cx, cy) = lens.focals, lens.centre
        turn = entry.rotation
        cameras.append(
            Camera(
                f"view{view}",
                np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                np.array(lens.distortion or ()),
                None if turn is None else _matrix(turn),
                None if entry.translation is None else np.array(entry.translation),
                fisheye=lens.model == "fisheye",
            )
        )
    return cameras


def triangulated(keypoints: Float32, cameras: Cameras) -> Float64:
    """Triangulate points (N, P, 3) from views (N, K, P, 2) with K static cameras.

    Raises
    ------
    ValueError
        If fewer than two cameras have a pose.
    """
    posed = [v for v, camera in enumerate(cameras) if camera.rotation is not None]
    if len(posed) < 2:
        raise ValueError(f"expected two cameras with a pose at least, got {len(posed)}")
    directions = [cameras[v].straighten(keypoints[:, v]) for v in posed]
    poses = [np.column_stack((cameras[v].rotation, cameras[v].translation)) for v in posed]  # type: ignore[arg-type]
    return triangulate(np.stack(directions, 1), np.stack(poses)).points3d


def _matrix(rotation: object) -> Float64:
    array = np.array(rotation, np.float64)
    return rotation_matrix(array) if array.shape == (3,) else array
