"""A stream of frames over a WebSocket, each answered before the next tick of the cameras."""

import asyncio
import logging
from collections import deque
from contextlib import suppress

import orjson
from fastapi import APIRouter, WebSocket
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError
from starlette.responses import Response
from starlette.websockets import WebSocketDisconnect

from models.lifting.lift import Lift
from service.http.dependencies import refuse_if_leaving
from service.http.errors import (
    PROBLEMS,
    ApiError,
    FieldError,
    from_validation,
    invalid,
    problems,
    translated,
)
from service.http.operations import register
from service.http.origins import refuse_foreign
from service.realtime.engine import Engine
from service.realtime.frames import check_views
from service.realtime.rooms import Rooms
from service.realtime.stream_frames import Frame, json_object, read_frame, seen_bytes, write_answer
from service.realtime.warm_models import WarmModel
from service.settings import Settings
from service.wire.rooms import is_room
from service.wire.stream_messages import (
    StreamAnswer,
    StreamDropped,
    StreamError,
    StreamFrame,
    StreamLimits,
    StreamReady,
    StreamStart,
)
from worker.rooms import Room

FRAMES_IN_HAND = 16  # of one stream; what waits longer is out of date
MAX_DROPPED = 10_000  # frames, until a client that reads no answers is not read from either
CLOSE_CODE = 4000  # plus the status of the problem that ends a stream

logger = logging.getLogger(__name__)
router = APIRouter(tags=["lift"])

register(StreamStart, StreamReady, StreamFrame, StreamAnswer, StreamDropped, StreamError)


def _messages(*names: str) -> dict[str, list[dict[str, str]]]:
    return {"oneOf": [{"$ref": f"#/components/schemas/{name}"} for name in names]}


@router.get(
    "/lift/stream",
    operation_id="stream_lifts",
    status_code=101,
    response_class=Response,
    responses=problems("upgrade_required", "origin_not_allowed", "overloaded")
    | {101: {"description": "The protocol is now WebSocket."}},
    openapi_extra={
        "x-websocket": {
            "client": _messages("StreamStart", "StreamFrame"),
            "server": _messages("StreamReady", "StreamAnswer", "StreamDropped", "StreamError"),
        }
    },
)
async def ask_for_upgrade() -> Response:
    """Lift frames as they come, over a WebSocket: `ws://.../lift/stream`.

    The client's first message is a `StreamStart`, the server's a `StreamReady`. Then every
    `StreamFrame`, or frame as bytes, gets a `StreamAnswer`, or one as bytes, in the order they
    came. With `on_overload: latest` a `StreamDropped` may come between. A bad frame gets a
    `StreamError` and the stream goes on; other errors close it, with 4000 plus the status of the
    problem. docs/streaming.md has the layout of the bytes and a client.
    """
    raise ApiError(
        "upgrade_required",
        "expected a WebSocket: ask for ws://.../lift/stream with a WebSocket library",
        headers={"Upgrade": "websocket", "Connection": "Upgrade"},
    )


@router.websocket("/lift/stream")
async def stream(websocket: WebSocket) -> None:
    """Talk to one client until it leaves, or falls silent, or its model is gone."""
    places: asyncio.Semaphore = websocket.app.state.streams
    refusal = _refusal(websocket, places)
    if refusal is not None:
        await websocket.send_denial_response(refusal.response())
        return
    async with places:
        await websocket.accept()
        try:
            await _converse(websocket)
        except WebSocketDisconnect:
            return
        except Exception as error:
            ending = translated(error)
            if ending.code == "internal_error":
                logger.exception("A stream failed")
        with suppress(WebSocketDisconnect):
            await websocket.send_text(_error_text(ending, None))
            await websocket.close(CLOSE_CODE + PROBLEMS[ending.code][0])


def _refusal(websocket: WebSocket, places: asyncio.Semaphore) -> ApiError | None:
    """Return why the handshake is refused, if it is."""
    try:
        refuse_foreign(websocket)
        refuse_if_leaving(websocket)
    except ApiError as error:
        return error
    if places.locked():
        return ApiError(
            "overloaded",
            "As many streams are open as may be; try again when some are closed.",
            headers={"Retry-After": "10"},
        )
    return None


async def _converse(websocket: WebSocket) -> None:
    engine: Engine = websocket.app.state.engine
    settings: Settings = websocket.app.state.settings
    patience = settings.stream_idle_seconds
    try:
        async with asyncio.timeout(patience) as silence:
            start = _read_start(await _receive(websocket))
            model = engine.models.warm(start.model)
            if model is None:
                model = await run_in_threadpool(engine.models.get, start.model)
            if start.views is not None:
                check_views(start.views, model.prior, len(start.views))
            room = None
            if is_room(start.frame, start.up):
                rooms: Rooms = websocket.app.state.rooms
                room = rooms.remembered(model, start.up)
                if room is None:
                    room = await run_in_threadpool(rooms.find, model, start.up)
            conversation = _Conversation(websocket, engine, settings, start, model, room)
            await websocket.send_text(conversation.ready().model_dump_json())
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(conversation.write())
                    await conversation.read(silence)
            except ExceptionGroup as group:
                raise group.exceptions[0] from None
            finally:
                conversation.give_up()
    except TimeoutError:
        raise ApiError("idle", f"expected a message within {patience:g} s") from None


class _Conversation:
    """One stream: frames that have arrived, frames whose lift was asked for, answers in order."""

    def __init__(
        self,
        websocket: WebSocket,
        engine: Engine,
        settings: Settings,
        start: StreamStart,
        model: WarmModel,
        room: Room | None,
    ) -> None:
        self._websocket, self._engine, self._settings = websocket, engine, settings
        self._start, self._model, self._room = start, model, room
        self._prior = prior = model.prior
        self._refine = start.refine or prior.config.refine
        self._continuity = start.continuity and self._refine != "off" and prior.cameras is not None
        self._latest = start.on_overload == "latest"
        self._at_a_time = 1 if self._latest or self._continuity else FRAMES_IN_HAND
        self._arrived: deque[Frame] = deque()
        self._asked: deque[tuple[Frame, asyncio.Future[Lift] | None]] = deque()
        self._previous: Lift | None = None
        self._something_asked = asyncio.Event()
        self._something_answered = asyncio.Event()

    def ready(self) -> StreamReady:
        """Return what the server says first."""
        return StreamReady(
            model=self._start.model,
            keypoints=self._prior.keypoints_per_frame,
            views=self._start.views,
            refine=self._refine,
            on_overload=self._start.on_overload,
            continuity=self._continuity,
            frame=self._start.frame,
            up=self._start.up,
            seen_bytes=seen_bytes(self._prior.keypoints_per_frame),
            limits=StreamLimits(
                message_bytes=self._settings.max_stream_bytes,
                frames_in_hand=FRAMES_IN_HAND,
                idle_seconds=self._settings.stream_idle_seconds,
            ),
        )

    async def read(self, silence: asyncio.Timeout) -> None:
        """Take frames as they come, until the client leaves; as many as may be in hand."""
        now, patience = asyncio.get_running_loop().time, self._settings.stream_idle_seconds
        while True:
            silence.reschedule(now() + patience)
            message = await _receive(self._websocket)
            frame = read_frame(message, self._prior, self._room, self._start.views, self._settings)
            self._arrived.append(frame)
            self._ask()
            if self._latest:
                self._drop_stale()
            while self._is_full():
                self._something_answered.clear()
                await self._something_answered.wait()

    def _is_full(self) -> bool:
        if self._latest:
            return bool(self._arrived) and len(self._arrived[0].dropped) >= MAX_DROPPED
        return len(self._arrived) + len(self._asked) >= FRAMES_IN_HAND

    def _drop_stale(self) -> None:
        while len(self._arrived) > 1:
            stale = self._arrived.popleft()
            if stale.sequence is not None:
                stale.dropped.append(stale.sequence)
            self._arrived[0].dropped = stale.dropped

    def _ask(self) -> None:
        """Ask for the lifts of frames that have arrived, as many as may be asked for at a time."""
        while self._arrived and len(self._asked) < self._at_a_time:
            frame = self._arrived.popleft()
            self._asked.append((frame, self._lift(frame)))
            self._something_asked.set()

    def _lift(self, frame: Frame) -> asyncio.Future[Lift] | None:
        if frame.capture is None:
            return None
        keypoints = frame.capture.keypoints
        before = self._previous
        if before is not None and before.scales.shape[1] != keypoints.shape[1]:
            before = None  # of other views
        return self._engine.lift(
            self._model,
            keypoints,
            confidence=frame.capture.confidence,
            refine=self._refine,
            views=self._start.views,
            previous=before,
        )

    async def write(self) -> None:
        """Answer the frames in their order."""
        send = self._websocket.send
        while True:
            while not self._asked:
                self._something_asked.clear()
                await self._something_asked.wait()
            frame, answer = self._asked[0]
            if answer is None:
                assert frame.error is not None  # noqa: S101
                message: str | bytes = _error_text(frame.error, frame.sequence)
            else:
                lift = await answer
                if self._continuity:
                    self._previous = lift
                if self._room is not None:
                    lift = self._room.place(lift, self._start.views)
                message = write_answer(frame, lift, self._prior)
            self._asked.popleft()
            self._ask()
            self._something_answered.set()
            if frame.dropped:
                notice = {"type": "dropped", "sequences": frame.dropped}
                await self._websocket.send_text(orjson.dumps(notice).decode())
            await send(
                {"type": "websocket.send", "text" if isinstance(message, str) else "bytes": message}
            )

    def give_up(self) -> None:
        """Leave the engine's queue."""
        for _, answer in self._asked:
            if answer is not None:
                answer.cancel()


async def _receive(websocket: WebSocket) -> str | bytes:
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    text: str | None = message.get("text")
    data: bytes | None = message.get("bytes")
    return text if text is not None else data or b""


def _read_start(message: str | bytes) -> StreamStart:
    if isinstance(message, bytes):
        raise invalid(
            "", "expected JSON in the first message: the model and how to lift, got bytes"
        )
    try:
        return StreamStart.model_validate(json_object(message))
    except ValidationError as error:
        raise from_validation(error, StreamStart) from error


def _error_text(error: ApiError, sequence: int | None) -> str:
    return StreamError(
        sequence=sequence,
        code=error.code,
        detail=error.detail,
        errors=[FieldError(pointer=pointer, detail=detail) for pointer, detail in error.errors],
    ).model_dump_json()
