"""Reading the frames of a stream, and writing their answers in the form the frames came in."""

import math
from dataclasses import dataclass, field

import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import ValidationError

from models.findings.finding import dumped
from models.lifting.fitted_prior import FittedPrior
from models.lifting.frames_json import frames_to_json
from models.lifting.lift import LiftedFrames
from models.lifting.lift_findings import lift_findings
from models.settings.times import MAX_TIME
from models.settings.uncertainty import ARRAYS, Uncertainty, numbers_of, of_uncertainty
from service.http.errors import ApiError, from_validation, invalid
from service.http.json_bounds import check_bounds
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
    QUALITY,
    TIME,
    VIEW,
    WITH_CONFIDENCE,
    WITH_TIME,
    StreamFlush,
    StreamFrame,
)
from service.wire.watch_messages import WATCHED
from store.capture import Capture
from worker.rooms import Room

Float32 = NDArray[np.float32]
FLOAT = 4  # bytes
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
    time
        When it was taken, in seconds; 0 where that is not asked for.
    flush
        It is no frame, but asks for the answers to those before.
    arrived
        When it was read, by `time.perf_counter`.
    """

    binary: bool
    sequence: int | None = None
    capture: Capture | None = None
    error: ApiError | None = None
    dropped: list[int] = field(default_factory=list)
    time: float = 0.0
    flush: bool = False
    arrived: float = 0.0


class FilmClock:
    """Gives the times of frames in a stream with a lag, and checks that they rise."""

    def __init__(self, fps: float | None) -> None:
        """Begin; without `fps` every frame has its time."""
        self._fps, self._last = fps, -math.inf

    def begin_anew(self) -> None:
        """Forget the frames so far."""
        self._last = -math.inf

    def time_of(self, sequence: int | None, given: float | None) -> float:
        """Return the time of the next frame; raise ``ApiError`` if it is missing or not later."""
        if self._fps is None:
            field, time = "/time", given
            if time is None:
                raise invalid(
                    field, "expected the time of the frame in seconds: this stream has a lag"
                )
        else:
            if given is not None:
                raise invalid("/time", "expected none: this stream has `fps`")
            field, time = "/sequence", (sequence or 0) / self._fps
        if not abs(time) <= MAX_TIME:
            raise invalid(field, f"expected seconds, {MAX_TIME:g} at most, got {time:g}")
        if time <= self._last:
            raise invalid(
                field,
                f"expected a frame that is later than the one before, at {self._last:g} s; got "
                f'{time:g} s. Send {{"flush": true}} first if another film begins',
            )
        self._last = time
        return time


def read_frame(
    message: str | bytes,
    prior: FittedPrior,
    room: Room | None,
    views: list[int] | None,
    settings: Settings,
    clock: FilmClock | None = None,
) -> Frame:
    """Return the frame in a message, or with an error if the model or the views do not allow it.

    Of a stream with a lag it has a time, by its `clock`, or is a flush.
    """
    frame, timed = Frame(binary=isinstance(message, bytes)), clock is not None
    points = prior.keypoints_per_frame
    try:
        if isinstance(message, bytes):
            keypoints, confidence, time = _from_bytes(frame, message, points, timed=timed)
        else:
            found = json_object(message)
            if clock is not None and "flush" in found:
                flush = _read_flush(found)
                clock.begin_anew()
                return flush
            keypoints, confidence, time = _from_json(frame, found, points, settings, timed=timed)
        capture = to_frames(keypoints, confidence, views, prior, settings, field="keypoints")
        if room is not None:
            check_known(room, views, capture.keypoints.shape[1])
        if clock is not None:
            frame.time = clock.time_of(frame.sequence, time)
        frame.capture = capture
    except ApiError as error:
        frame.error = error
    return frame


def _read_flush(found: dict[str, object]) -> Frame:
    try:
        check_bounds(found, StreamFlush)
        StreamFlush.model_validate(found)
    except ValidationError as error:
        raise from_validation(error, StreamFlush) from error
    return Frame(binary=False, flush=True)


_Read = tuple[Float32, Float32 | None, float | None]  # keypoints, confidence, time


def _from_bytes(frame: Frame, message: bytes, points: int, *, timed: bool) -> _Read:
    if len(message) < HEADER.size:
        raise invalid("", f"expected a header of {HEADER.size} bytes, got {len(message)} bytes")
    kind, flags, views, frame.sequence = HEADER.unpack_from(message)
    if kind != FRAME:
        raise invalid("/kind", f"expected {FRAME}, a frame, got {kind}")
    if flags & ~(WITH_CONFIDENCE | WITH_TIME * timed):
        more = f", {WITH_TIME} with its time, or both" if timed else ""
        raise invalid(
            "/flags", f"expected 0, or {WITH_CONFIDENCE} with confidence{more}, got {flags}"
        )
    trusted, start = bool(flags & WITH_CONFIDENCE), HEADER.size
    start += TIME.size if flags & WITH_TIME else 0
    expected = start + 4 * views * points * (3 if trusted else 2)
    if len(message) != expected:
        raise invalid(
            "/keypoints",
            f"expected {expected} bytes for {views} views x {points} keypoints "
            f"{'with' if trusted else 'without'} confidence, got {len(message)}",
        )
    values = np.frombuffer(message, "<f4", offset=start)
    keypoints, rest = np.split(values, [2 * views * points])
    confidence = rest.reshape(1, views, points) if trusted else None
    time = TIME.unpack_from(message, HEADER.size)[0] if flags & WITH_TIME else None
    return keypoints.reshape(1, views, points, 2), confidence, time


def _from_json(
    frame: Frame, found: dict[str, object], points: int, settings: Settings, *, timed: bool
) -> _Read:
    sequence = found.get("sequence")
    frame.sequence = sequence if type(sequence) is int and 0 <= sequence < 2**32 else None
    try:
        check_bounds(found, StreamFrame)
        sent = StreamFrame.model_validate(found)
    except ValidationError as error:
        raise from_validation(error, StreamFrame) from error
    if not timed and "time" in found:
        raise invalid("/time", "expected none: this stream was opened without `lag`")
    limit = settings.max_stream_bytes
    keypoints = from_nested(
        sent.keypoints,
        "/keypoints",
        axes=POINT_AXES[1:],
        sizes=(None, points, 2),
        max_bytes=limit,
    )
    confidence = None
    if sent.confidence is not None:
        confidence = from_nested(
            sent.confidence,
            "/confidence",
            axes=POINT_AXES[1:3],
            sizes=(len(keypoints), points),
            max_bytes=limit,
        )[None]
    return keypoints[None], confidence, sent.time


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


def uncertainty_bytes(keypoints: int, uncertainty: Uncertainty) -> int:
    """Return how many bytes an answer has of how far points may be off."""
    return FLOAT * keypoints * numbers_of(uncertainty)


def quality_bytes(uncertainty: Uncertainty) -> int:
    """Return how many bytes an answer has of how far its frame may be relied on."""
    return 0 if uncertainty == "off" else QUALITY.size


def write_answer(
    frame: Frame, lift: LiftedFrames, prior: FittedPrior, uncertainty: Uncertainty
) -> str | bytes:
    """Return the answer to a frame, lifted by a prior: text if it came as text, else bytes."""
    if frame.binary:
        return _as_bytes(ANSWER, frame, lift, uncertainty)
    (text,) = frames_to_json(of_uncertainty(lift.arrays, uncertainty))
    answer = {
        "type": "answer",
        "sequence": frame.sequence,
        "continued": bool(lift.continued[0]),
        "frame": orjson.Fragment(text),
        "findings": dumped(lift_findings(lift, prior)),
    }
    return orjson.dumps(answer).decode()


def write_watched(frame: Frame, lift: LiftedFrames, uncertainty: Uncertainty) -> bytes:
    """Return the answer to a frame and its keypoints, for who watches the stream."""
    assert frame.capture is not None  # noqa: S101
    keypoints = frame.capture.keypoints.astype("<f4", copy=False)
    shown: Uncertainty = "off" if uncertainty == "off" else "sd"
    return _as_bytes(WATCHED, frame, lift, shown) + keypoints.tobytes()


def _as_bytes(kind: int, frame: Frame, lift: LiftedFrames, uncertainty: Uncertainty) -> bytes:
    views = np.empty(lift.scales.shape[1], VIEW)
    for name in VIEW.names or ():
        views[name] = getattr(lift, name)[0]
    flags = LIFTED * (lift.status[0] == "ok") | CONTINUED * bool(lift.continued[0])
    flags |= int(lift.findings[0]) << FINDINGS
    header = HEADER.pack(kind, flags, len(views), frame.sequence)
    points, *others = (
        getattr(lift, name).astype("<f4", copy=False).tobytes()
        for name in ("points3d", "outlier_probability", *ARRAYS[uncertainty])
    )
    seen = lift.keypoints_seen.tobytes().ljust(seen_bytes(lift.keypoints_seen.shape[1]), b"\0")
    quality = QUALITY.pack(lift.quality[0], lift.quality_reason[0])[: quality_bytes(uncertainty)]
    return b"".join((header, points, views.tobytes(), seen, *others, quality))
