"""The JSON forms of keypoints and lifts."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema
from typing_extensions import TypeAliasType

from models.findings.catalogue import LiftCode
from models.posterior.quality import DOUBTFUL
from models.settings.keypoints import OUTLIER
from models.settings.uncertainty import MODES, SYMMETRIC
from store.labels import Text

_NUMBER: dict[str, Any] = {"anyOf": [{"type": "number"}, {"type": "null"}]}


def _list_of(items: dict[str, Any], **limits: int) -> dict[str, Any]:
    return {"type": "array", "items": items, **limits}


def _nullable(schema: dict[str, Any]) -> dict[str, Any]:
    return {"anyOf": [schema, {"type": "null"}]}


def _point(size: int) -> dict[str, Any]:
    return _nullable(_list_of(_NUMBER, minItems=size, maxItems=size))


_VIEWS_OF_KEYPOINTS = _list_of(_nullable(_list_of(_point(2))))
_VIEWS_OF_CONFIDENCE = _list_of(_nullable(_list_of(_NUMBER)))
KEYPOINTS_SCHEMA = _list_of(_nullable(_VIEWS_OF_KEYPOINTS)) | {
    "title": "Keypoints",
    "description": "frames x views x keypoints x (x, y), pixels, x right, y down. null for a "
    "coordinate, a keypoint, a whole view or a frame that was not observed.",
}
CONFIDENCE_SCHEMA = _nullable(_list_of(_nullable(_VIEWS_OF_CONFIDENCE))) | {
    "title": "Confidence",
    "description": "frames x views x keypoints, in [0, 1]; 0 or null counts as not observed.",
}
POINTS3D_SCHEMA = _nullable(_list_of(_nullable(_list_of(_point(3))))) | {
    "title": "Points3D",
    "description": "Ground truth, for evaluation only: frames x keypoints x (x, y, z), in metres "
    "or any unit of yours; null where unknown.",
}
TIMES_SCHEMA = _nullable(
    {"anyOf": [_list_of({"type": "number"}), _list_of(_list_of({"type": "number"}))]}
) | {
    "title": "Times",
    "description": "Times of the frames in seconds, rising: one number for each frame, or frames x "
    "views if every camera has its own clock.",
}
FRAME_KEYPOINTS_SCHEMA = _VIEWS_OF_KEYPOINTS | {
    "title": "Keypoints of a frame",
    "description": "views x keypoints x (x, y), as in a request of `POST /lift`.",
}
FRAME_CONFIDENCE_SCHEMA = _nullable(_VIEWS_OF_CONFIDENCE) | {
    "title": "Confidence of a frame",
    "description": "views x keypoints, in [0, 1]; 0 or null counts as not observed.",
}

# Turned into arrays by service.wire.arrays, many times faster than lists validated item by item.
KEYPOINTS = Annotated[Any, WithJsonSchema(KEYPOINTS_SCHEMA)]
CONFIDENCE = Annotated[Any, WithJsonSchema(CONFIDENCE_SCHEMA)]
FRAME_KEYPOINTS = Annotated[Any, WithJsonSchema(FRAME_KEYPOINTS_SCHEMA)]
FRAME_CONFIDENCE = Annotated[Any, WithJsonSchema(FRAME_CONFIDENCE_SCHEMA)]
POINTS3D = Annotated[Any, WithJsonSchema(POINTS3D_SCHEMA)]
TIMES = Annotated[Any, WithJsonSchema(TIMES_SCHEMA)]

Name = Annotated[Text, Field(min_length=1, max_length=200)]

REFINE = (
    "Perspective refinement: `auto` unless it explains a frame's keypoints worse than the network "
    "by more than a quarter, `full` wherever it can be computed, `off` never; the default is that "
    "of the fit."
)
UNCERTAINTY = (
    "How far points may be off. `sd`: `points3d_sd`. `full`: `points3d_covariance` and "
    "`points3d_modes`, too, by which deviations of lengths, angles and ratios can be computed. "
    "`off`: none of them."
)
VIEWS = (
    "Which of the fitted views these are: one index per view, none twice. Without it they are "
    "those of the fit in its order if the numbers agree, else unknown cameras."
)

Vector2 = Annotated[list[float], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Covariance = Annotated[list[float], Field(min_length=SYMMETRIC, max_length=SYMMETRIC)]
Modes = Annotated[
    list[Annotated[list[float], Field(min_length=MODES, max_length=MODES)]],
    Field(min_length=3, max_length=3),
]
Rotation = Annotated[list[Vector3], Field(min_length=3, max_length=3)]


CameraModel = TypeAliasType("CameraModel", Literal["weak_perspective", "perspective", "fisheye"])
FrameStatus = TypeAliasType("FrameStatus", Literal["ok", "too_few_keypoints", "not_in_room"])
QualityReason = TypeAliasType(
    "QualityReason", Literal["little_evidence", "views_disagree", "unlike_fit", "no_evidence"]
)
Distortion = Annotated[list[float], Field(min_length=8, max_length=8)]


class LiftedView(BaseModel):
    """One view's camera.

    Weak perspective: `w = scale * (rotation @ X)[:2] + translation`. Perspective and fisheye:
    `x = rotation @ X + translation`, which OpenCV's `projectPoints` (or `fisheye.projectPoints`)
    turns into pixels with `focal`, `principal_point` and `distortion`.
    """

    camera: CameraModel

    rotation: Rotation = Field(
        description="3x3, orthonormal, determinant 1: canonical frame to camera (x right, y down, "
        "z forward)."
    )
    scale: float = Field(
        description="Pixels per unit of `points3d`, at the structure's centre in perspective."
    )
    translation: Annotated[list[float], Field(min_length=2, max_length=3)] = Field(
        description="Weak perspective: (x, y), pixels. Otherwise (x, y, z), units of `points3d`."
    )
    focal: Vector2 | None = Field(
        description="Focal length along x and y, pixels; null for weak perspective."
    )
    principal_point: Vector2 | None = Field(
        description="(x, y), pixels; null for weak perspective."
    )
    distortion: Distortion | None = Field(
        description="OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6; fisheye: k1 to k4, then "
        "zeros. Null for weak perspective."
    )
    reprojection_error: float = Field(
        description="Pixels, the mean distance over the observed keypoints."
    )


LIFTED_FRAME: dict[str, Any] = {
    "status": "ok",
    "reason": None,
    "points3d": [[0.1, -0.9, 0.0], [0.1, 0.3, 0.1], [-0.3, 0.2, 0.0], [0.1, 0.4, -0.1]],
    "points3d_sd": [0.012, 0.015, 0.11, 0.013],
    "keypoints_seen": [1, 1, 0, 1],
    "outlier_probability": [[0.001, 0.0, 0.998, 0.004], [None, None, None, None]],
    "quality": 0.83,
    "quality_reason": None,
    "views": [
        {
            "camera": "perspective",
            "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "scale": 212.4,
            "translation": [-0.6, -0.58, 5.2],
            "focal": [1104.5, 1104.5],
            "principal_point": [640.0, 512.0],
            "distortion": [-0.11, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            "reprojection_error": 1.8,
        },
        None,
    ],
    "findings": [],
}


class LiftedFrame(BaseModel):
    """One frame, lifted."""

    model_config = ConfigDict(json_schema_extra={"example": LIFTED_FRAME})

    status: FrameStatus
    reason: str | None = Field(description="Why there is no answer, if there is none.")
    points3d: list[Vector3 | None] | None = Field(
        description="The canonical structure, keypoints x (x, y, z): centred, right-handed. Null "
        "for a keypoint that two views of the fit never showed in the same frame, and for one that "
        "fewer than two views show of this frame if its answer is far from where it usually is."
    )
    points3d_sd: list[float | None] | None = Field(
        description="How far each point may be off: the root mean square of its expected distance "
        "from the true one, units of `points3d`. The structure's place and direction are no part "
        "of it, nor is its size unless static cameras give it. Null in weak perspective, in what "
        "older versions stored or fitted, and with `uncertainty: off`."
    )
    points3d_covariance: list[Covariance | None] | None = Field(
        None,
        description="Only with `uncertainty: full`: the covariance C of each point, xx, xy, xz, "
        "yy, yz, zz, squares of the unit of `points3d`. Null where `points3d_sd` is.",
    )
    points3d_modes: list[Modes | None] | None = Field(
        None,
        description=f"Only with `uncertainty: full`: {MODES} modes U, keypoints x (x, y, z) x "
        "modes, units of `points3d`: how points are off together. The covariance of all "
        "coordinates of a structure is blockdiag(C - U U^T) + U U^T. Null where `points3d_sd` is.",
    )
    keypoints_seen: list[int] | None = Field(
        description="How many views show each keypoint: 0, it is inferred from the others; 1, so "
        "is its depth. Null in what older versions stored."
    )
    outlier_probability: list[list[float | None]] | None = Field(
        description="How probably each keypoint of each view (views x keypoints) is an outlier, 0 "
        f"to 1. What exceeds {OUTLIER} was left out of the lift or, where left and right were "
        "swapped, used in its partner's place. Null for what was not observed, "
        "and in all where the model judges no outliers, of cameras that the fit does not know, and "
        "in what older versions stored."
    )
    quality: float | None = Field(
        description="How far the frame may be relied on, 0 to 1: 1 for one that is as the frames "
        "of the fit usually are, 0 for one without a structure. Null where `points3d_sd` is null "
        "in all, but for `uncertainty: off`."
    )
    quality_reason: QualityReason | None = Field(
        description=f"Why the quality is below {DOUBTFUL:g}: points may be off by more than they "
        "usually may (`little_evidence`), keypoints lie farther from where the answer is seen "
        "(`views_disagree`), the structure is unlike the shapes of the fit (`unlike_fit`), or "
        "there is none (`no_evidence`)."
    )
    views: list[LiftedView | None] = Field(
        description="One camera per view, null where the view shows too few keypoints."
    )
    findings: list[LiftCode] = Field(description="Codes of what was noticed of this frame.")
