"""Frames of keypoints as JSON, from UDP or standard input."""

import asyncio
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
FIELDS = {"sequence", "keypoints", "confidence", "time"}


class Frame(NamedTuple):
    """A frame: its sender's number, (K, P, 2) pixels, (K, P) confidence, and when it came."""

    sequence: int
    keypoints: NDArray[np.float32]
    confidence: NDArray[np.float32] | None
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
            f"the unknown fields {sorted(unknown)}" if isinstance(document, dict) else "no object"
        )
        raise ValueError(f"a frame has {what}: expected {', '.join(sorted(FIELDS))}")
    sequence = document.get("sequence")
    if type(sequence) is not int or not 0 <= sequence < 2**32:
        raise ValueError("sequence: expected a whole number from 0 to 4294967295")
    keypoints = _array(document.get("keypoints"), "keypoints", (count, 2))
    confidence = document.get("confidence")
    if confidence is not None:
        confidence = _array(confidence, "confidence", (count,))
        if len(confidence) != len(keypoints):
            raise ValueError("confidence: expected as many views as in keypoints")
    return Frame(sequence, keypoints, confidence, arrival.come)


def _array(value: Any, field: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return lists for each view as an array (K, *shape), NaN for what is null."""
    expected = f"{field}: expected views of {shape[0]} keypoints as in the model"
    if not isinstance(value, list) or not value:
        raise ValueError(expected)
    missing = [None] * 2
    views = []
    for view in value:
        if not isinstance(view, list) or len(view) != shape[0]:
            raise ValueError(expected)
        views.append([missing if len(shape) > 1 and each is None else each for each in view])
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
    threading.Thread(
        target=_read_lines, args=(sys.stdin.buffer, queue, loop), daemon=True, name="lines"
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
