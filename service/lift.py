"""Lifting: 2D keypoints to 3D structure and cameras, in real time."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from models.config import Index, Refine
from models.fitted import FittedPrior
from service.bodies import request_body
from service.deps import EngineDep, SettingsDep
from service.errors import BODY_PROBLEMS, invalid, problems
from service.representations import FormatQuery, arrays_response, binary_responses
from service.settings import Settings
from service.uploads import Upload, UploadBody, read_arrays, to_capture
from service.wire import CONFIDENCE, KEYPOINTS, LIFTED_FRAME, LiftedFrame, lift_arrays

router = APIRouter(tags=["lift"])

REFINE = (
    "Perspective refinement: `auto` where the residuals say that it helps, `full` wherever it can "
    "be computed, `off` never; without it what the fit was told."
)
VIEWS = (
    "Which of the fitted views these are: one index per view that comes, none twice. Without it "
    "the fit's own order if as many come, else cameras of which nothing is known."
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
                "refine": "auto",
                "views": [0, 2],
            }
        },
    )

    model: str = Field(max_length=200, description="The model's identifier.")
    frames: KEYPOINTS
    confidence: CONFIDENCE = None
    refine: Refine | None = Field(None, description=REFINE)
    views: list[Index] | None = Field(None, description=VIEWS)


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
RefineQuery = Annotated[Refine | None, Query(description=REFINE)]
ViewsQuery = Annotated[
    list[Index] | None, Query(description=f"{VIEWS} Repeat it: `views=0&views=2`.")
]


def _read(upload: Upload, model: str | None, settings: Settings) -> LiftRequest:
    if upload.is_json:
        return upload.json(LiftRequest)
    if model is None:
        raise invalid("/model", "expected the model's identifier in the query: /lift?model=mdl_...")
    found = read_arrays(upload, settings, frozenset({"frames", "keypoints", "confidence"}))
    frames = found.get("frames", found.get("keypoints"))
    if frames is None:
        raise invalid("/frames", "expected an array of this name: (frames, views, keypoints, 2)")
    return LiftRequest(model=model, frames=frames, confidence=found.get("confidence"))


def _check_views(views: list[int], prior: FittedPrior, came: int) -> None:
    """Raise ``ApiError`` unless ``views`` says of each view that came which of the fit's it is."""
    if len(views) != came:
        raise invalid("/views", f"expected one index per view: {came}, got {len(views)}")
    if len(set(views)) < came:
        raise invalid("/views", f"expected different views of the fit, got {views}")
    fitted = None if prior.cameras is None else len(prior.cameras.resting)
    if fitted is not None and max(views) >= fitted:
        raise invalid("/views", f"expected views of the fit, 0 to {fitted - 1}, got {max(views)}")


@router.post(
    "/lift",
    operation_id="lift",
    response_model=Lift,
    responses=problems(*BODY_PROBLEMS, "not_found", "not_acceptable")
    | binary_responses("The lifted frames."),
    openapi_extra=request_body(
        LiftRequest,
        binary="A safetensors or .npz file with `frames` (or `keypoints`: frames, views, "
        "keypoints, 2) and optionally `confidence`; the query says the rest.",
    ),
)
def lift(
    upload: UploadBody,
    engine: EngineDep,
    settings: SettingsDep,
    request: Request,
    model: ModelQuery = None,
    refine: RefineQuery = None,
    views: ViewsQuery = None,
    format: FormatQuery = None,
) -> Response:
    """Lift frames to 3D with a fitted model.

    The query says what the body does not: of bytes `model`, of either `refine` and `views`.

    Any number of the views, in any order; missing keypoints and views allowed. Every frame is
    lifted on its own. Structures come in the model's canonical frame, with the handedness that
    the fit settled on. Each view's `camera` says by which camera model it was explained.
    """
    asked = _read(upload, model, settings)
    if asked.views is not None:
        views = asked.views
    prior = engine.prior(asked.model)
    expected = prior.keypoints_per_frame
    capture = to_capture(
        asked.frames,
        asked.confidence,
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
    if views is not None:
        _check_views(views, prior, capture.keypoints.shape[1])
    lifted = prior.lift(
        capture.keypoints,
        confidence=capture.confidence,
        refine=asked.refine or refine,
        views=views,
    )
    return arrays_response(
        request, lift_arrays(lifted), {"model": asked.model}, format=format, filename="lift"
    )
