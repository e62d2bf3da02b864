"""The JSON form of the cameras that a fit found."""

from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from typing_extensions import TypeAliasType

from models.calibrating.result import CameraReport
from models.findings.finding import Finding
from models.settings.calibration import LiftedLensName
from models.settings.rooms import BestFrame
from service.wire.findings import Findings
from service.wire.schemas import Distortion, Rotation, Vector2, Vector3
from service.wire.stages import STAGES, AnswerStage
from store.records import FitRecord

FoundArrangement = TypeAliasType(
    "FoundArrangement", Literal["static", "moving", "mixed", "unknown"]
)

EXAMPLE_FINDING = Finding.of(
    "calibration_disagrees", views=[0], noise=1.9, noise_as_given=7.3, focal_ratio=1.21
).model_dump(mode="json")
UNKNOWN = (
    "This model was fitted without refinement (refine: off), or by an older Fewview, or to "
    "keypoints that do not determine cameras, such as those of a single view: its views are weak "
    "perspective, with another camera in every frame."
)


class FoundView(BaseModel):
    """The camera of one view. The standard deviation of a given number is 0.

    Numbers that could not be estimated are null.
    """

    index: int = Field(description="Which view of the fit; what `views` of `POST /lift` counts.")
    camera: LiftedLensName
    static: bool = Field(description="Whether it is static relative to the other static cameras.")
    focal: Vector2 | None = Field(description="Focal length along x and y, pixels.")
    focal_sd: float | None = Field(description="Pixels.")
    principal_point: Vector2 | None = Field(description="(x, y), pixels.")
    principal_point_sd: Vector2 | None = Field(description="(x, y), pixels.")
    distortion: Distortion | None = Field(
        description="OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6; fisheye: k1 to k4, then zeros."
    )
    distortion_sd: Vector2 | None = Field(description="Of the first two coefficients.")
    rotation: Rotation | None = Field(
        description="R of `x = R X + t`, 3x3, OpenCV's axes; null for a camera that moves."
    )
    rotation_sd: float | None = Field(description="Degrees.")
    translation: Vector3 | None = Field(
        description="t of `x = R X + t`, in units of the structures; null for a camera that moves."
    )
    translation_sd: Vector3 | None = Field(description="The same unit.")
    reprojection_error: float | None = Field(
        description="Pixels, mean over the frames it was estimated from."
    )


_EXAMPLE: dict[str, Any] = {
    "arrangement": "mixed",
    "reason": "View 0 keeps its place to 0.02 units over 400 frames; view 1 moves.",
    "findings": [EXAMPLE_FINDING],
    "noise": 1.9,
    "frame_of_reference": "upright",
    "views": [
        {
            "index": 0,
            "camera": "perspective",
            "static": True,
            "focal": [1104.5, 1104.5],
            "focal_sd": 6.2,
            "principal_point": [640.0, 512.0],
            "principal_point_sd": [0.0, 0.0],
            "distortion": [-0.11, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            "distortion_sd": [0.01, 0.02],
            "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "rotation_sd": 0.0,
            "translation": [0.0, 0.0, 0.0],
            "translation_sd": [0.0, 0.0, 0.0],
            "reprojection_error": 2.4,
        },
        {
            "index": 1,
            "camera": "perspective",
            "static": False,
            "focal": [1098.1, 1098.1],
            "focal_sd": 11.0,
            "principal_point": [640.0, 512.0],
            "principal_point_sd": [0.0, 0.0],
            "distortion": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            "distortion_sd": [0.0, 0.0],
            "rotation": None,
            "rotation_sd": None,
            "translation": None,
            "translation_sd": None,
            "reprojection_error": 2.6,
        },
    ],
}


class _Cameras(BaseModel):
    arrangement: FoundArrangement = Field(
        description="`mixed`: some are static and some move; `unknown`: cameras were not estimated."
    )
    reason: str = Field(description="Why, in words.")
    findings: Findings = Field(
        description="Findings about the cameras, such as a calibration that contradicts the "
        "keypoints."
    )
    noise: float | None = Field(
        description="Pixels, the standard deviation of a keypoint's coordinate about the model."
    )
    frame_of_reference: BestFrame = Field(
        description="The best one that frames of the model's fit can be asked for: `upright` "
        "(`frame=room&up=auto`), `room` (`frame=room`) or `canonical`."
    )
    handedness_certainty: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Probability that structures are no mirror images; 1 if the handedness was"
        " given, null for models of an older Fewview. Below 0.99 there is a finding.",
    )
    views: list[FoundView] = Field(description="Of the fit, in its order; none if unknown.")


class ModelCameras(_Cameras):
    """The cameras that a fit estimated.

    Static cameras share one frame of reference: that of the first of them, or the one in which
    their poses were given.
    """

    model_config = ConfigDict(
        json_schema_extra={"example": {"model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr", **_EXAMPLE}}
    )

    model: str

    @classmethod
    def of(cls, model_id: str, found: CameraReport | None, frame: BestFrame) -> Self:
        """Return the wire form of what a model's fit found."""
        return cls.model_validate({"model": model_id, **_fields_of(found, frame)})


class FitCameras(_Cameras):
    """The cameras that a fit has estimated by now, as of its model when it has succeeded."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "fit_id": "fit_01m7yspf3gqz6cz1v8e7ch3y7c",
                "model": None,
                "stage": "geometry",
                **_EXAMPLE,
            }
        }
    )

    fit_id: str
    model: str | None = Field(description="Null while the fit goes on.")
    stage: AnswerStage = Field(description=STAGES)

    @classmethod
    def of(
        cls, fit: FitRecord, stage: AnswerStage, found: CameraReport | None, frame: BestFrame
    ) -> Self:
        """Return the wire form of what a fit found."""
        about = {"fit_id": fit.id, "model": fit.model_id, "stage": stage}
        return cls.model_validate({**about, **_fields_of(found, frame)})


def _fields_of(found: CameraReport | None, frame: BestFrame) -> dict[str, Any]:
    if found is None:
        return {
            "arrangement": "unknown",
            "reason": UNKNOWN,
            "findings": [],
            "noise": None,
            "frame_of_reference": frame,
            "views": [],
        }
    views = [
        {
            "index": view,
            "camera": found.camera_models[view],
            "static": bool(found.static[view]),
            "focal": _known(found.focals[view]),
            "focal_sd": _known(found.focal_sds[view]),
            "principal_point": _known(found.principal_points[view]),
            "principal_point_sd": _known(found.principal_point_sds[view]),
            "distortion": _known(found.distortions[view]),
            "distortion_sd": _known(found.distortion_sds[view]),
            "rotation": _known(found.rotations[view]),
            "rotation_sd": _known(found.rotation_sds[view]),
            "translation": _known(found.translations[view]),
            "translation_sd": _known(found.translation_sds[view]),
            "reprojection_error": _known(found.reprojection_errors[view]),
        }
        for view in range(len(found.static))
    ]
    return {
        "arrangement": found.arrangement,
        "reason": found.reason,
        "findings": list(found.findings),
        "noise": _known(found.noise),
        "frame_of_reference": frame,
        "handedness_certainty": _known(found.handedness_certainty),
        "views": views,
    }


def _known(value: Any) -> Any:
    """Return numbers as lists, or None if not all of them are finite."""
    return np.asarray(value).tolist() if np.isfinite(value).all() else None
