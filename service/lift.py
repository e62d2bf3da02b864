"""Lifting: 2D keypoints to 3D structure and cameras, in real time."""

from dataclasses import fields
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from models.fitted import Lift as LiftArrays
from service.bodies import request_body
from service.deps import EngineDep, SettingsDep
from service.errors import BODY_PROBLEMS, invalid, problems
from service.representations import FormatQuery, arrays_response, binary_responses
from service.uploads import Upload, UploadBody, read_arrays, to_capture
from service.wire import CONFIDENCE, KEYPOINTS, LIFTED_FRAME, LiftedFrame

router = APIRouter(tags=["lift"])

ARRAYS = tuple(
    field.name for field in fields(LiftArrays) if field.name not in ("status", "reasons")
)


class LiftRequest(BaseModel):
    """Frames to lift."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "frames": [
                    [
                        [[512.0, 200.5], [530.0, 260.0], None, [498.0, 402.0]],
                        [[301.0, 190.0], [322.5, 251.0], [350.0, 330.0], [310.0, 399.0]],
                    ]
                ],
            }
        },
    )

    model: str = Field(max_length=200, description="The model's identifier.")
    frames: KEYPOINTS
    confidence: CONFIDENCE = None


class Lift(BaseModel):
    """Lifted frames, in the order they came."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {"model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr", "frames": [LIFTED_FRAME]}
        }
    )

    model: str
    frames: list[LiftedFrame]


ModelQuery = Annotated[
    str | None,
    Query(max_length=200, description="The model's identifier, for frames that come as bytes."),
]


def _read(upload: Upload, model: str | None, settings: SettingsDep) -> tuple[str, Any, Any]:
    if upload.is_json:
        body = upload.json(LiftRequest)
        return body.model, body.frames, body.confidence
    if model is None:
        raise invalid("/model", "expected the model's identifier in the query: /lift?model=mdl_...")
    found = read_arrays(upload, settings, frozenset({"frames", "keypoints", "confidence"}))
    frames = found.get("frames", found.get("keypoints"))
    if frames is None:
        raise invalid("/frames", "expected an array of this name: (frames, views, keypoints, 2)")
    return model, frames, found.get("confidence")


@router.post(
    "/lift",
    operation_id="lift",
    response_model=Lift,
    responses=problems(*BODY_PROBLEMS, "not_found", "not_acceptable")
    | binary_responses("The lifted frames."),
    openapi_extra=request_body(
        LiftRequest,
        binary="A safetensors or .npz file with `frames` (or `keypoints`: frames, views, "
        "keypoints, 2) and optionally `confidence`; the model is named in the query.",
    ),
)
def lift(
    upload: UploadBody,
    engine: EngineDep,
    settings: SettingsDep,
    request: Request,
    model: ModelQuery = None,
    format: FormatQuery = None,
) -> Response:
    """Lift frames to 3D with a fitted model.

    Any number of the views, in any order; missing keypoints and views allowed. Every frame is
    lifted on its own. Structures come in the model's canonical frame; weak perspective cannot
    tell a structure from its mirror image, so the handedness is the model's, the same for all
    frames.
    """
    model_id, frames, confidence = _read(upload, model, settings)
    prior = engine.prior(model_id)
    expected = prior.keypoints_per_frame
    capture = to_capture(
        frames,
        confidence,
        settings=settings,
        keypoints_field="frames",
        expected_keypoints=expected,
    )
    came = capture.keypoints.shape[2]
    if came != expected:
        raise invalid(
            "/frames",
            f"expected {expected} keypoints as in the model, got {came}; keep the order of the "
            "fitted capture and write null for what was not observed",
        )
    lifted = prior.lift(capture.keypoints, confidence=capture.confidence)
    found: dict[str, np.ndarray[Any, Any]] = {name: getattr(lifted, name) for name in ARRAYS}
    return arrays_response(request, found, {"model": model_id}, format=format, filename="lift")
