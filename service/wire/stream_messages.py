"""The messages of a stream of frames: JSON, or bytes of a fixed little-endian layout.

A frame in bytes:  kind u8 = 1, flags u8, views u16 (K), sequence u32, with flag 2 its time f64,
                   keypoints f32 (K, P, 2) and, with flag 1, confidence f32 (K, P). NaN: not
                   observed.
Its answer:        kind u8 = 2, flags u8, views u16 (K), sequence u32, points3d f32 (P, 3) and K
                   times `VIEW`, keypoints_seen u8 (P), zeros up to a multiple of 4 bytes,
                   outlier_probability f32 (K, P), then the arrays of the stream's `uncertainty`:
                   points3d_sd f32 (P), points3d_covariance f32 (P, 6), points3d_modes f32
                   (P, 3, 12). NaN: no answer. Unless it is `off`, `QUALITY` is last. Flag 1: the
                   frame could be lifted, 2: its refinement started from the answer before, 4, 8,
                   16 and 32: see `FINDINGS`.
"""

import struct
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from typing_extensions import TypeAliasType

from models.settings.config import Index, Refine
from models.settings.keypoints import MAX_VIEWS
from models.settings.rooms import FrameOfReference, Up
from models.settings.times import MAX_FPS, MAX_LAG, MIN_FPS
from models.settings.uncertainty import Uncertainty
from service.http.errors import FieldError
from service.wire.findings import Findings
from service.wire.rooms import FRAME_OF_REFERENCE, UP
from service.wire.schemas import (
    FRAME_CONFIDENCE,
    FRAME_KEYPOINTS,
    LIFTED_FRAME,
    REFINE,
    UNCERTAINTY,
    VIEWS,
    LiftedFrame,
)
from store.labels import Text

FRAME, ANSWER = 1, 2  # kinds
WITH_CONFIDENCE, WITH_TIME = 1, 2  # flags of a frame
LIFTED, CONTINUED = 1, 2  # flags of an answer
FINDINGS = 2  # bits by which the sum of a frame's findings (`Lift.findings`) is shifted in flags
ALIGNED = 4  # bytes that a message is a multiple of
HEADER, TIME = struct.Struct("<BBHI"), struct.Struct("<d")
QUALITY = struct.Struct("<fB3x")  # NaN: not known; and the place of its reason, from 1, or 0
VIEW = np.dtype(
    [
        ("camera_models", "<i4"),  # -1 none, 0 weak perspective, 1 perspective, 2 fisheye
        ("rotations", "<f4", (3, 3)),
        ("scales", "<f4"),
        ("translations", "<f4", (3,)),
        ("focals", "<f4", (2,)),
        ("principal_points", "<f4", (2,)),
        ("distortions", "<f4", (8,)),
        ("reprojection_errors", "<f4"),
    ]
)

Overload = TypeAliasType("Overload", Literal["latest", "all"])


class StreamStart(BaseModel):
    """A client's first message: the frames that it will send."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "views": [0, 2],
                "refine": "auto",
                "on_overload": "latest",
                "continuity": True,
                "frame": "room",
                "up": "auto",
            }
        },
    )

    model: Text = Field(max_length=200, description="The model's identifier, or an alias.")
    views: list[Index] | None = Field(None, min_length=1, max_length=MAX_VIEWS, description=VIEWS)
    refine: Refine | None = Field(None, description=REFINE)
    on_overload: Overload = Field(
        "all",
        description="What happens to frames that come faster than they are lifted. `all`: none is "
        "lost, and the server reads no further until it has answered. `latest`: the newest takes "
        "the place of one that waits, which is dropped.",
    )
    continuity: bool = Field(
        False,
        description="Frames follow each other in time: the refinement of each may start from the "
        "answer before, which is faster and steadier.",
    )
    frame: FrameOfReference = Field("canonical", description=FRAME_OF_REFERENCE)
    up: Up | None = Field(None, description=UP)
    uncertainty: Uncertainty = Field("sd", description=UNCERTAINTY)
    lag: int | None = Field(
        None,
        ge=0,
        le=MAX_LAG,
        description="Smooth frames in time, and answer each when so many more have arrived: the "
        "more, the more accurate. Every frame needs its time, or `fps` is given. Only for models "
        "of captures with times whose noise could be separated from motion. Without it every frame "
        "is lifted as it arrives.",
    )
    fps: float | None = Field(
        None,
        ge=MIN_FPS,
        le=MAX_FPS,
        description="Frames per second, in place of `time` in each frame of a stream with `lag`: "
        "`sequence` then counts the frames that the cameras take, also those that are not sent.",
    )

    @field_validator("fps")
    @classmethod
    def _of_smoothed_frames(cls, fps: float | None, info: ValidationInfo) -> float | None:
        if fps is not None and info.data.get("lag") is None:
            raise ValueError("expected `lag` with it: frames are smoothed in time only then")
        return fps


class StreamLimits(BaseModel):
    """The limits of a stream."""

    message_bytes: int = Field(description="Longest message.")
    frames_in_hand: int = Field(description="Frames that the server takes before it has answered.")
    idle_seconds: float = Field(description="Silence after which it closes the stream.")


class StreamReady(BaseModel):
    """The answer to the first message: what was understood."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "ready",
                "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
                "keypoints": 17,
                "views": [0, 2],
                "refine": "auto",
                "on_overload": "latest",
                "continuity": True,
                "frame": "room",
                "up": "auto",
                "uncertainty": "sd",
                "header_bytes": 8,
                "view_bytes": 108,
                "seen_bytes": 20,
                "uncertainty_bytes": 68,
                "quality_bytes": 8,
                "limits": {"message_bytes": 262144, "frames_in_hand": 16, "idle_seconds": 60.0},
            }
        }
    )

    type: Literal["ready"] = "ready"
    model: str
    keypoints: int = Field(description="Keypoints P that every view of a frame must have.")
    views: list[int] | None
    refine: Refine = Field(description="The refinement used, given or by default.")
    on_overload: Overload
    continuity: bool
    frame: FrameOfReference
    up: Up | None
    uncertainty: Uncertainty = Field(description=UNCERTAINTY)
    lag: int | None = Field(None, description="Only where it was asked for, as is `fps`.")
    fps: float | None = None
    header_bytes: int = Field(HEADER.size, description="Of a binary message, before its arrays.")
    view_bytes: int = Field(VIEW.itemsize, description="Of each view in a binary answer.")
    seen_bytes: int = Field(
        description="Of `keypoints_seen` after the views of a binary answer: one for each "
        f"keypoint, and zeros up to a multiple of {ALIGNED}. `outlier_probability` follows."
    )
    uncertainty_bytes: int = Field(
        description="Of what follows `outlier_probability` in a binary answer: `points3d_sd` "
        "unless `uncertainty` is `off`, and if it is `full` `points3d_covariance` and "
        "`points3d_modes`. Streams of services that do not have this field end before."
    )
    quality_bytes: int = Field(
        description="Of what ends a binary answer: `quality` as a float, `quality_reason` as a "
        "byte, from 1, or 0, and zeros. 0 if `uncertainty` is `off`. Streams of services that do "
        "not have this field end before."
    )
    limits: StreamLimits


class StreamFrame(BaseModel):
    """One frame, as JSON."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "sequence": 7,
                "keypoints": [
                    [[512.0, 200.5], [530.0, 260.0], None, [498.0, 402.0]],
                    [[301.0, 190.0], [322.5, 251.0], [350.0, 330.0], [310.0, 399.0]],
                ],
            }
        },
    )

    sequence: int = Field(
        strict=True, ge=0, le=2**32 - 1, description="Any number of the client's own."
    )
    keypoints: FRAME_KEYPOINTS
    confidence: FRAME_CONFIDENCE = None
    time: float | None = Field(
        None,
        allow_inf_nan=False,
        strict=True,
        description="Its time in seconds, later than that of the previous frame; only in streams "
        "with `lag` and without `fps`, which need it.",
    )


class StreamFlush(BaseModel):
    """Asks for the answers to all frames so far, in a stream with `lag`.

    The next frame has none before it to be smoothed with.
    """

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"flush": True}})

    flush: Literal[True]


class StreamAnswer(BaseModel):
    """The answer to a frame that came as JSON."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "answer",
                "sequence": 7,
                "continued": True,
                "frame": LIFTED_FRAME,
                "findings": [],
            }
        }
    )

    type: Literal["answer"]
    sequence: int
    continued: bool = Field(description="Whether refinement started from the answer before.")
    frame: LiftedFrame
    findings: Findings


class StreamDropped(BaseModel):
    """Frames that get no answer because newer ones took their places (`on_overload`: `latest`)."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"type": "dropped", "sequences": [8, 9, 10]}}
    )

    type: Literal["dropped"]
    sequences: list[int]


class StreamError(BaseModel):
    """What is wrong with a message. After a frame's the stream goes on, else it is closed."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "error",
                "sequence": 11,
                "code": "invalid_input",
                "detail": "keypoints: expected 17 keypoints as in the model, got 16",
                "errors": [
                    {
                        "pointer": "/keypoints",
                        "detail": "expected 17 keypoints as in the model, got 16",
                    }
                ],
            }
        }
    )

    type: Literal["error"] = "error"
    sequence: int | None = Field(description="Of the frame; null if there was none to be read.")
    code: str = Field(description="As in problem details.")
    detail: str
    errors: list[FieldError]
