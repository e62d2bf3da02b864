"""Reading the frames of a stream, and writing their answers in the form the frames came in."""

from dataclasses import dataclass, field

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import ValidationError

from models.findings.finding import dumped
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import Lift
from models.lifting.lift_findings import lift_findings
from service.http.errors import ApiError, from_validation, invalid
from service.realtime.frames import to_frames
from service.realtime.rooms import check_known
from service.settings import Settings
from service.wire.arrays import from_nested
from service.wire.captures import POINT_AXES
from service.wire.stream_messages import (
    ALIGNED,
    ANSWER,
    CONTINUED,
    FINDINGS,
    FRAME,
    HEADER,
    LIFTED,
    VIEW,
    WITH_CONFIDENCE,
    StreamFrame,
)
from store.capture import Capture
from worker.rooms import Room

Float32 = NDArray[np.float32]
_NOT_OBSERVED = "JSON knows no NaN: write null for what was not observed."


@dataclass(eq=False, slots=True)
class Frame:
    """A frame on its way through a stream.

    Attributes
    ----------
    binary
        Whether it came as bytes.
    sequence
        The client's number; None where it could not be read.
    capture
        The keypoints (1, K, P, 2) and their confidence; None where there is an error.
    error
        What is wrong with it.
    dropped
        Sequence numbers of frames before it that get no answer.
    """

    binary: bool
    sequence: int | None = None
    capture: Capture | None = None
    error: ApiError | None = None
    dropped: list[int] = field(default_factory=list)


def read_frame(
    message: str | bytes,
    prior: FittedPrior,
    room: Room | None,
    views: list[int] | None,
    settings: Settings,
) -> Frame:
    """Return the frame in a message, or with an error if the model or the views do not allow it."""
    frame = Frame(binary=isinstance(message, bytes))
    try:
        if isinstance(message, bytes):
            keypoints, confidence = _from_bytes(frame, message, prior.keypoints_per_frame)
        else:
            keypoints, confidence = _from_json(frame, message, prior.keypoints_per_frame, settings)
        capture = to_frames(keypoints, confidence, views, prior, settings, field="keypoints")
        if room is not None:
            check_known(room, views, capture.keypoints.shape[1])
        frame.capture = capture
    except ApiError as error:
        frame.error = error
    return frame


def _from_bytes(frame: Frame, message: bytes, points: int) -> tuple[Float32, Float32 | None]:
    if len(message) < HEADER.size:
        raise invalid("", f"expected a header of {HEADER.size} bytes, got {len(message)} bytes")
    kind, flags, views, frame.sequence = HEADER.unpack_from(message)
    if kind != FRAME:
        raise invalid("/kind", f"expected {FRAME}, a frame, got {kind}")
    if flags & ~WITH_CONFIDENCE:
        raise invalid("/flags", f"expected 0, or {WITH_CONFIDENCE} with confidence, got {flags}")
    numbers = views * points * (3 if flags else 2)
    if len(message) != HEADER.size + 4 * numbers:
        raise invalid(
            "/keypoints",
            f"expected {HEADER.size + 4 * numbers} bytes for {views} views x {points} keypoints "
            f"{'with' if flags else 'without'} confidence, got {len(message)}",
        )
    values = np.frombuffer(message, "<f4", offset=HEADER.size)
    keypoints, rest = np.split(values, [2 * views * points])
    confidence = rest.reshape(1, views, points) if flags else None
    return keypoints.reshape(1, views, points, 2), confidence


def _from_json(
    frame: Frame, message: str, points: int, settings: Settings
) -> tuple[Float32, Float32 | None]:
    found = json_object(message)
    sequence = found.get("sequence")
    frame.sequence = sequence if type(sequence) is int and 0 <= sequence < 2**32 else None
    try:
        sent = StreamFrame.model_validate(found)
    except ValidationError as error:
        raise from_validation(error, StreamFrame) from error
    keypoints = from_nested(
        sent.keypoints,
        "/keypoints",
        axes=POINT_AXES[1:],
        sizes=(None, points, 2),
        max_bytes=settings.max_stream_bytes,
    )
    if sent.confidence is None:
        return keypoints[None], None
    confidence = from_nested(
        sent.confidence,
        "/confidence",
        axes=POINT_AXES[1:3],
        sizes=(len(keypoints), points),
        max_bytes=settings.max_stream_bytes,
    )
    return keypoints[None], confidence[None]


def json_object(message: str) -> dict[str, object]:
    """Return the object in a JSON text; raise ``ApiError`` if there is none."""
    try:
        found = orjson.loads(message)
    except orjson.JSONDecodeError as error:
        raise ApiError(
            "malformed_body", f"The message is not valid JSON: {error}. {_NOT_OBSERVED}"
        ) from error
    if not isinstance(found, dict):
        raise invalid("", f"expected a JSON object, got {type(found).__name__}")
    return found


def seen_bytes(keypoints: int) -> int:
    """Return how many bytes `keypoints_seen` takes in an answer."""
    return -(-keypoints // ALIGNED) * ALIGNED


def write_answer(frame: Frame, lift: Lift, prior: FittedPrior) -> str | bytes:
    """Return the answer to a frame, lifted by a prior: text if it came as text, else bytes."""
    continued = bool(lift.continued[0])
    if not frame.binary:
        (text,) = frames_to_json(lift.arrays)
        answer = {
            "type": "answer",
            "sequence": frame.sequence,
            "continued": continued,
            "frame": orjson.Fragment(text),
            "findings": dumped(lift_findings(lift, prior)),
        }
        return orjson.dumps(answer).decode()
    views = np.empty(lift.scales.shape[1], VIEW)
    for name in VIEW.names or ():
        views[name] = getattr(lift, name)[0]
    flags = LIFTED * (lift.status[0] == "ok") | CONTINUED * continued
    flags |= int(lift.findings[0]) << FINDINGS
    header = HEADER.pack(ANSWER, flags, len(views), frame.sequence)
    points, outlying = (
        numbers.astype("<f4", copy=False) for numbers in (lift.points3d, lift.outlier_probability)
    )
    seen = lift.keypoints_seen.tobytes().ljust(seen_bytes(lift.keypoints_seen.shape[1]), b"\0")
    return b"".join((header, points.tobytes(), views.tobytes(), seen, outlying.tobytes()))
