"""Streams that are open, and the messages to who watches one: JSON, and frames as bytes.

A frame in bytes:  as the answer to a frame (`service.wire.stream_messages`), but of kind 3, without
                   covariances and modes, and with the keypoints that were sent, f32 (K, P, 2),
                   after it.
"""

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from models.settings.config import Refine
from models.settings.rooms import FrameOfReference, Up
from models.settings.uncertainty import Uncertainty
from service.wire.rooms import FRAME_OF_REFERENCE, UP
from service.wire.schemas import REFINE, UNCERTAINTY, VIEWS
from service.wire.stream_messages import Overload

WATCHED = 3  # the kind of a frame that is watched

EXAMPLE: dict[str, Any] = {
    "id": "stream_01m7ysqde9xx2qq81h8t3gh6xr",
    "model": "mdl_01m7ysqde9xx2qq81h8t3gh6xr",
    "key_id": "key_01m7yspdypmt22jq6npfg62xe5",
    "since": "2026-03-01T09:30:00Z",
    "keypoints": 17,
    "views": [0, 2],
    "refine": "auto",
    "on_overload": "latest",
    "continuity": True,
    "frame": "room",
    "up": "auto",
    "uncertainty": "sd",
    "lag": None,
    "frames_per_second": 59.8,
    "latency_ms": 2.1,
    "latency_p95_ms": 3.4,
    "answered": 5382,
    "dropped": 3,
    "refused": 0,
    "not_lifted": 12,
}


class LiftStream(BaseModel):
    """A stream that is open, and how it goes; figures are a second old at most."""

    model_config = ConfigDict(json_schema_extra={"example": EXAMPLE})

    id: str
    model: str
    key_id: str = Field(description="The key that opened it; `owner` without one.")
    since: datetime = Field(description="When it was opened.")
    keypoints: int = Field(description="Keypoints P of every view.")
    views: list[int] | None = Field(description=VIEWS)
    refine: Refine = Field(description=REFINE)
    on_overload: Overload
    continuity: bool
    frame: FrameOfReference = Field(description=FRAME_OF_REFERENCE)
    up: Up | None = Field(description=UP)
    uncertainty: Uncertainty = Field(
        "off",  # of processes of an older version
        description=f"{UNCERTAINTY} Frames that are watched have `points3d_sd` alone.",
    )
    lag: int | None = Field(
        description="Frames that each answer waits for; null: it waits for none."
    )
    frames_per_second: float = Field(description="Frames answered in the last second.")
    latency_ms: float | None = Field(
        description="From when a frame was read until it was answered, median of the last second; "
        "null if none was."
    )
    latency_p95_ms: float | None = Field(description="The 95th percentile of the same.")
    answered: int = Field(description="Frames, as are the following.")
    dropped: int = Field(description="Newer ones took their places.")
    refused: int = Field(description="Answered by an error.")
    not_lifted: int = Field(description="Of those answered: they show too little.")


class LiftStreams(BaseModel):
    """The streams that are open, those opened last first."""

    model_config = ConfigDict(json_schema_extra={"example": {"items": [EXAMPLE]}})

    items: list[LiftStream]


class StreamState(LiftStream):
    """The stream that is watched, as it is now; comes first, and then every second."""

    model_config = ConfigDict(json_schema_extra={"example": {"type": "state", **EXAMPLE}})

    type: Literal["state"] = "state"


class StreamEnded(BaseModel):
    """The stream that was watched has ended."""

    model_config = ConfigDict(json_schema_extra={"example": {"type": "ended"}})

    type: Literal["ended"] = "ended"
