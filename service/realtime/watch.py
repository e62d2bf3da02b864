"""Streams that others have opened: which there are, and watching one without slowing it."""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from functools import partial

import orjson
from fastapi import APIRouter, Request, WebSocket
from redis.asyncio.client import PubSub
from redis.exceptions import RedisError
from starlette.requests import HTTPConnection
from starlette.responses import Response

from service.http.dependencies import Identifier
from service.http.errors import ApiError, problems
from service.http.keyring import caller_of
from service.http.operations import register
from service.realtime.open_streams import ENDED, KEPT_SECONDS, OpenStreams
from service.realtime.sockets import beside, messages, receive, serve, upgrade_required
from service.wire.stream_messages import StreamError
from service.wire.watch_messages import WATCHED, LiftStreams, StreamEnded, StreamState

SILENT_SECONDS = KEPT_SECONDS + 1.0  # of a stream, whose process may have been killed
STATE, FRAME, END = "state", "frame", "end"  # kinds of messages

logger = logging.getLogger(__name__)
router = APIRouter(prefix="/lift/streams", tags=["lift"])

register(StreamState, StreamEnded, StreamError)


@router.get("", responses=problems())
async def list_lift_streams(request: Request) -> LiftStreams:
    """List the streams of the project that are open, in all processes of the API."""
    streams: OpenStreams = request.app.state.open_streams
    return LiftStreams.model_validate({"items": await streams.of(_project(request))})


@router.get(
    "/{stream_id}/watch",
    status_code=101,
    response_class=Response,
    responses=problems("not_found", "upgrade_required", "origin_not_allowed")
    | {101: {"description": "The protocol is now WebSocket."}},
    openapi_extra={
        "x-websocket": {"server": messages("StreamState", "StreamEnded", "StreamError")}
    },
)
async def watch_lift_stream(stream_id: Identifier, request: Request) -> Response:
    """Watch a stream, over a WebSocket: `ws://.../lift/streams/{stream_id}/watch`.

    A `StreamState` comes at once and every second, and frames as bytes, 30 a second at most: each
    answer with the keypoints that it was computed from. A client that reads slowly misses frames;
    the stream does not wait for it. When it ends a `StreamEnded` comes, and the socket is closed.
    docs/streaming.md has the layout of the bytes.
    """
    streams: OpenStreams = request.app.state.open_streams
    if await streams.get(_project(request), stream_id) is None:
        raise _not_open(stream_id)
    raise upgrade_required(f"/lift/streams/{stream_id}/watch")


@router.websocket("/{stream_id}/watch")
async def watch(websocket: WebSocket) -> None:
    """Show one stream to one client until either leaves."""
    await serve(websocket, websocket.app.state.event_places, _watch)


def _not_open(stream_id: str) -> ApiError:
    return ApiError("not_found", f"No stream {stream_id!r} is open: it may have ended.")


def _project(connection: HTTPConnection) -> str:
    return caller_of(connection).author.project


class _Newest:
    """What is to be sent: of each kind the newest message alone."""

    def __init__(self) -> None:
        self._waiting: dict[str, bytes] = {}
        self._something = asyncio.Event()

    def put(self, kind: str, message: bytes) -> None:
        """Have a message take the place of one of its kind that was not taken yet."""
        self._waiting[kind] = message
        self._something.set()

    async def take(self) -> dict[str, bytes]:
        """Wait until there are messages, and return them."""
        await self._something.wait()
        self._something.clear()
        waiting, self._waiting = self._waiting, {}
        return waiting


async def _watch(websocket: WebSocket) -> None:
    streams: OpenStreams = websocket.app.state.open_streams
    stream_id: str = websocket.path_params["stream_id"]
    ask = partial(streams.get, _project(websocket), stream_id)
    newest = _Newest()
    try:
        async with streams.subscribed(stream_id) as heard:
            state = await ask()
            if state is None:
                raise _not_open(stream_id)
            newest.put(STATE, orjson.dumps(state))
            await beside(
                _send(websocket, newest), _until_it_leaves(websocket), _hear(heard, newest, ask)
            )
    except RedisError as error:
        logger.warning("A stream is not watched: %r", error)
        raise ApiError(
            "unavailable",
            "Streams cannot be watched while Redis cannot be reached. They themselves go on.",
        ) from None


async def _until_it_leaves(websocket: WebSocket) -> None:
    while True:
        await receive(websocket)


async def _hear(heard: PubSub, newest: _Newest, ask: Callable[[], Awaitable[object]]) -> None:
    """Take what comes of a stream; ask whether it is still open after a silence."""
    last = time.monotonic()
    while True:
        message = await heard.get_message(timeout=SILENT_SECONDS)
        if message is not None:
            last, data = time.monotonic(), message["data"]
            kind = END if data == ENDED else FRAME if data[0] == WATCHED else STATE
            newest.put(kind, data)
        elif time.monotonic() - last >= SILENT_SECONDS:
            if await ask() is None:
                newest.put(END, ENDED)
            last = time.monotonic()


async def _send(websocket: WebSocket, newest: _Newest) -> None:
    """Send the newest of what came, until the stream ends."""
    while True:
        for kind, message in (await newest.take()).items():
            if kind == FRAME:
                await websocket.send_bytes(message)
            elif kind == STATE:
                state = StreamState.model_validate_json(message)
                await websocket.send_text(state.model_dump_json())
            else:
                await websocket.send_text(StreamEnded().model_dump_json())
                return
