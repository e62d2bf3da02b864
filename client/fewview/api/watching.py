"""Streams that are open in the service: which there are, and watching one as it goes."""

import json
from collections.abc import AsyncIterable, AsyncIterator, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
from websockets.asyncio.client import connect as connect_async
from websockets.sync.client import connect

from fewview.api.forms import form_in, read
from fewview.api.operations import Driver, Resource, operation
from fewview.api.steps import Request, Steps, path
from fewview.api.stream import Line, opening, talking
from fewview.api.stream_messages import Answer, read_message, refusal
from fewview.capture import Float32


@dataclass(frozen=True)
class OpenStream:
    """A stream that is open; figures are of the last second, counts of frames so far.

    Attributes
    ----------
    key_id
        The key that opened it.
    latency_ms, latency_p95_ms
        From reading a frame until its answer; None if there was none.
    raw
        The whole JSON object, with the options of the stream.
    """

    id: str
    model: str
    key_id: str
    since: datetime
    keypoints: int
    frames_per_second: float
    latency_ms: float | None
    latency_p95_ms: float | None
    answered: int
    dropped: int
    refused: int
    not_lifted: int
    raw: dict[str, Any] = field(repr=False, compare=False)


@dataclass(frozen=True)
class _Listed:
    items: tuple[OpenStream, ...]


@dataclass(frozen=True, eq=False)
class WatchedFrame:
    """A frame of a stream that is watched: its keypoints (K, P, 2) as sent, and its answer."""

    keypoints: Float32
    answer: Answer


class Streams(Resource[Driver]):
    """``/lift/streams``."""

    @operation
    def list(self) -> Steps[tuple[OpenStream, ...]]:
        """Return the streams of the project that are open, those opened last first."""
        found = yield from self._call(Request("GET", "/lift/streams", form_in(_Listed)))
        return found.items


@contextmanager
def watch(line: Line, stream: OpenStream | str) -> Iterator[Iterator[OpenStream | WatchedFrame]]:
    """Give the states and frames of a stream until it ends."""
    url = _where(line, stream)
    with opening(url):
        connection = connect(url, **line.options())
    with connection:
        yield _read_all(connection)


def _read_all(connection: Iterable[str | bytes]) -> Iterator[OpenStream | WatchedFrame]:
    state: OpenStream | None = None
    with talking():
        for message in connection:
            found = _read(message, state)
            if found is None:
                return
            state = found if isinstance(found, OpenStream) else state
            yield found


@asynccontextmanager
async def watch_async(
    line: Line, stream: OpenStream | str
) -> AsyncIterator[AsyncIterator[OpenStream | WatchedFrame]]:
    """Do the same, to be awaited."""
    url = _where(line, stream)
    with opening(url):
        connection = await connect_async(url, **line.options())
    async with connection:
        yield _read_all_async(connection)


async def _read_all_async(
    connection: AsyncIterable[str | bytes],
) -> AsyncIterator[OpenStream | WatchedFrame]:
    state: OpenStream | None = None
    with talking():
        async for message in connection:
            found = _read(message, state)
            if found is None:
                return
            state = found if isinstance(found, OpenStream) else state
            yield found


def _where(line: Line, stream: OpenStream | str) -> str:
    identifier = stream if isinstance(stream, str) else stream.id
    return f"{line.base}{path('lift', 'streams', identifier, 'watch')}"


def _read(message: str | bytes, stream: OpenStream | None) -> OpenStream | WatchedFrame | None:
    """Return what a message of a stream has; None if it has ended."""
    if isinstance(message, str):
        document = json.loads(message)
        if document["type"] == "error":
            raise refusal(document)
        return None if document["type"] == "ended" else read(OpenStream, document)
    assert stream is not None  # noqa: S101 (a state comes first)
    keypoints = stream.keypoints
    shown = "off" if stream.raw.get("uncertainty", "off") == "off" else "sd"
    answer = read_message(message, keypoints, shown)
    assert isinstance(answer, Answer)  # noqa: S101
    views = len(answer.views)
    sent = np.frombuffer(message, "<f4", offset=len(message) - 8 * views * keypoints)
    return WatchedFrame(sent.reshape(views, keypoints, 2), answer)
