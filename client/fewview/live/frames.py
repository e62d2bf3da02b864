"""Frames of keypoints as JSON, from UDP or standard input."""

import asyncio
import io
import json
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LONGEST = 256 * 1024  # bytes of a frame, as the service takes them by default
WAITING = 2  # frames; of datagrams the newer ones stay
LATEST = 1e12  # seconds, as the service takes them
FIELDS = {"sequence", "keypoints", "confidence", "time"}
# A frame that comes after one of a higher number was overtaken on its way, if it is behind by fewer
# frames and seconds than these (guesses); else its sender has begun anew.
OVERTAKEN_FRAMES, OVERTAKEN_SECONDS = 100, 1.0


class Frame(NamedTuple):
    """A frame: its sender's number, (K, P, 2) pixels, (K, P) confidence, its time, when it came."""

    sequence: int
    keypoints: NDArray[np.float32]
    confidence: NDArray[np.float32] | None
    time: float | None  # seconds, of its sender's clock
    come: float  # of time.perf_counter


class Arrival(NamedTuple):
    """What came, not read yet, and when; None is the end."""

    data: bytes | None
    come: float


Queue = asyncio.Queue[Arrival]


def read_frame(arrival: Arrival, count: int) -> Frame:
    """Return a frame of P = `count` keypoints.

    Raises
    ------
    ValueError
        It is no frame; the text names the field, and no number in it is the frame's own.
    """
    data = arrival.data or b""
    if len(data) > LONGEST:
        raise ValueError(f"a frame has more than {LONGEST} bytes")
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        raise ValueError("a frame is not JSON") from None
    if not isinstance(document, dict) or (unknown := document.keys() - FIELDS):
        what = (
            f"has the unknown fields {sorted(unknown)}"
            if isinstance(document, dict)
            else "is no object"
        )
        raise ValueError(f"a frame {what}: expected {', '.join(sorted(FIELDS))}")
    sequence = document.get("sequence")
    if type(sequence) is not int or not 0 <= sequence < 2**32:
        raise ValueError("sequence: expected a whole number from 0 to 4294967295")
    keypoints = _array(document.get("keypoints"), "keypoints", (count, 2))
    confidence = document.get("confidence")
    if confidence is not None:
        confidence = _array(confidence, "confidence", (count,))
        if len(confidence) != len(keypoints):
            raise ValueError("confidence: expected as many views as in keypoints")
    moment = document.get("time")
    if moment is not None and (not _is_number(moment) or not abs(moment) <= LATEST):
        raise ValueError(f"time: expected seconds, {LATEST:g} at most")
    return Frame(sequence, keypoints, confidence, moment, arrival.come)


class Order:
    """The order of frames over a network, on which later ones may overtake earlier ones."""

    def __init__(self) -> None:
        self._newest, self._come = -1, -np.inf

    def is_overtaken(self, frame: Frame) -> bool:
        """Return whether a frame comes after one that its sender took later."""
        behind, after = self._newest - frame.sequence, frame.come - self._come
        if 0 < behind < OVERTAKEN_FRAMES and after < OVERTAKEN_SECONDS:
            return True
        self._newest, self._come = frame.sequence, frame.come
        return False


def _array(value: Any, field: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return lists for each view as an array (K, *shape), NaN for what is null."""
    each = "x and y, or null" if len(shape) > 1 else "a number, or null"
    expected = f"{field}: expected views of {shape[0]} keypoints as in the model, each {each}"
    if not isinstance(value, list) or not value:
        raise ValueError(expected)
    missing: list[Any] | None = [None] * 2 if len(shape) > 1 else None
    views = []
    for view in value:
        if view is None:
            views.append([missing] * shape[0])
            continue
        if not isinstance(view, list) or len(view) != shape[0]:
            raise ValueError(expected)
        views.append([missing if point is None else point for point in view])
    if not all(_is_number(each) for view in views for point in view for each in _parts(point)):
        raise ValueError(f"{field}: expected numbers, or null for what was not observed")
    try:
        array = np.array(views, np.float64)
    except (ValueError, OverflowError):
        raise ValueError(expected) from None
    if array.shape[1:] != shape:
        raise ValueError(expected)
    with np.errstate(over="ignore"):  # what is no float32 is refused by the service
        return array.astype(np.float32)


def _parts(point: Any) -> list[Any]:
    return point if isinstance(point, list) else [point]


def _is_number(value: Any) -> bool:
    return value is None or type(value) in {int, float}


class Datagrams(asyncio.DatagramProtocol):
    """Puts datagrams into a queue; the oldest gives way where too many wait."""

    def __init__(self, queue: Queue, dropped: Callable[[], None]) -> None:
        self._queue, self._dropped = queue, dropped

    def datagram_received(self, data: bytes, _address: object) -> None:
        """Keep a datagram."""
        if self._queue.full():
            self._queue.get_nowait()
            self._dropped()
        self._queue.put_nowait(Arrival(data, time.perf_counter()))


def follow_lines(queue: Queue) -> None:
    """Put the lines of standard input into a queue, which holds the reader back when it is full."""
    loop = asyncio.get_running_loop()
    lines: IO[bytes] = sys.stdin.buffer
    # Python ends with a fatal error where a thread that waits has the lock of its own buffer.
    raw = getattr(lines, "raw", None)
    lines = lines if raw is None else io.BufferedReader(raw)
    threading.Thread(
        target=_read_lines, args=(lines, queue, loop), daemon=True, name="lines"
    ).start()


def _read_lines(lines: IO[bytes], queue: Queue, loop: asyncio.AbstractEventLoop) -> None:
    with suppress(RuntimeError, asyncio.CancelledError):  # the loop has ended
        while line := lines.readline(LONGEST + 1):
            part = line
            while len(part) > LONGEST and not part.endswith(b"\n"):  # to the end of a long line
                part = lines.readline(LONGEST + 1)
            if line.strip():
                _put(queue, loop, line)
        _put(queue, loop, None)


def _put(queue: Queue, loop: asyncio.AbstractEventLoop, data: bytes | None) -> None:
    putting = queue.put(Arrival(data, time.perf_counter()))
    try:
        asyncio.run_coroutine_threadsafe(putting, loop).result()
    except RuntimeError:
        putting.close()
        raise
