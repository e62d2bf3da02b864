"""The JSON forms of keypoints and lifts."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema

from models.fitted import REASONS

_NUMBER: dict[str, Any] = {"anyOf": [{"type": "number"}, {"type": "null"}]}


def _list_of(items: dict[str, Any], **limits: int) -> dict[str, Any]:
    return {"type": "array", "items": items, **limits}


def _nullable(schema: dict[str, Any]) -> dict[str, Any]:
    return {"anyOf": [schema, {"type": "null"}]}


def _point(size: int) -> dict[str, Any]:
    return _nullable(_list_of(_NUMBER, minItems=size, maxItems=size))


KEYPOINTS_SCHEMA = _list_of(_list_of(_nullable(_list_of(_point(2))))) | {
    "title": "Keypoints",
    "description": "frames x views x keypoints x (x, y), pixels, x right, y down. null for a "
    "coordinate, a keypoint or a whole view that was not observed.",
}
CONFIDENCE_SCHEMA = _nullable(_list_of(_list_of(_nullable(_list_of(_NUMBER))))) | {
    "title": "Confidence",
    "description": "frames x views x keypoints, in [0, 1]; 0 or null counts as not observed.",
}
POINTS3D_SCHEMA = _nullable(_list_of(_nullable(_list_of(_point(3))))) | {
    "title": "Points3D",
    "description": "Ground truth, for evaluation only: frames x keypoints x (x, y, z), in metres "
    "or any unit of yours; null where unknown.",
}

# Turned into arrays by service.arrays, many times faster than lists validated item by item.
KEYPOINTS = Annotated[Any, WithJsonSchema(KEYPOINTS_SCHEMA)]
CONFIDENCE = Annotated[Any, WithJsonSchema(CONFIDENCE_SCHEMA)]
POINTS3D = Annotated[Any, WithJsonSchema(POINTS3D_SCHEMA)]

Vector2 = Annotated[list[float], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]


class LiftedView(BaseModel):
    """One view's weak-perspective camera: `w = scale * (rotation @ X)[:2] + translation`."""

    rotation: Annotated[list[Vector3], Field(min_length=3, max_length=3)] = Field(
        description="3x3, orthonormal, determinant 1: canonical frame to camera (x right, y down, "
        "z forward)."
    )
    scale: float = Field(description="Pixels per unit of `points3d`.")
    translation: Vector2 = Field(description="Pixels.")
    reprojection_error: float = Field(
        description="Pixels, the mean distance over the observed keypoints."
    )


LIFTED_FRAME: dict[str, Any] = {
    "status": "ok",
    "reason": None,
    "points3d": [[0.1, -0.9, 0.0], [0.1, 0.3, 0.1], [-0.3, 0.2, 0.0], [0.1, 0.4, -0.1]],
    "views": [
        {
            "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "scale": 212.4,
            "translation": [512.0, 388.5],
            "reprojection_error": 1.8,
        },
        None,
    ],
}


class LiftedFrame(BaseModel):
    """One frame, lifted."""

    model_config = ConfigDict(json_schema_extra={"example": LIFTED_FRAME})

    status: Literal["ok", "too_few_keypoints"]
    reason: str | None = Field(description="Why there is no answer, if there is none.")
    points3d: list[Vector3] | None = Field(
        description="The canonical structure, keypoints x (x, y, z): centred, right-handed."
    )
    views: list[LiftedView | None] = Field(
        description="One camera per view, null where the view shows too few keypoints."
    )


def frames_json(arrays: dict[str, NDArray[Any]]) -> list[dict[str, Any]]:
    """Return the JSON form of a lift's arrays, a dictionary like :class:`LiftedFrame` a frame."""
    answered = np.isfinite(arrays["points3d"]).all((1, 2)).tolist()
    has_camera = np.isfinite(arrays["scales"]).tolist()
    points, rotations, scales, translations, errors = (
        arrays[name].tolist()
        for name in ("points3d", "rotations", "scales", "translations", "reprojection_errors")
    )
    return [
        {
            "status": "ok" if answered[n] else "too_few_keypoints",
            "reason": None if answered[n] else REASONS["too_few_keypoints"],
            "points3d": points[n] if answered[n] else None,
            "views": [
                {
                    "rotation": rotations[n][k],
                    "scale": scales[n][k],
                    "translation": translations[n][k],
                    "reprojection_error": errors[n][k],
                }
                if has_camera[n][k]
                else None
                for k in range(len(scales[n]))
            ],
        }
        for n in range(len(points))
    ]
