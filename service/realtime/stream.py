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

from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.lifting.observing import Following
from service.http.authentication import subprotocol_of
from service.http.bounds import check_bounds
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
from service.http.keyring import caller_of, while_let_in
from service.http.operations import register
from service.http.origins import refuse_foreign
from service.http.rates import Rates
from service.realtime.engine import Engine
from service.realtime.frames import check_views
from service.realtime.rooms import Rooms
from service.realtime.smoothed_frames import SmoothedFrames
from service.realtime.stream_frames import (
    FilmClock,
    Frame,
    json_object,
    read_frame,
    seen_bytes,
    write_answer,
)
from service.realtime.warm_models import WarmModel
from service.settings import Settings
from service.wire.json_kinds import refuse_converted
from service.wire.rooms import is_room
from service.wire.stream_messages import (
    StreamAnswer,
    StreamDropped,
    StreamError,
    StreamFlush,
    StreamFrame,
    StreamLimits,
    StreamReady,
    StreamStart,
)
from worker.rooms import Room

FRAMES_IN_HAND = 16  # of one stream; what waits longer is out of date
MAX_DROPPED = 10_000  # frames, until a client that reads no answers is not read from either
CLOSE_CODE = 4000  # plus the status of the problem that ends a stream

# What is awaited of a frame: its lift, or in streams with a lag what its coming makes ready.
_Answer = asyncio.Future[LiftedFrames] | asyncio.Future[list[tuple[Frame, LiftedFrames]]]

logger = logging.getLogger(__name__)
router = APIRouter(tags=["lift"])

register(
    StreamStart, StreamReady, StreamFrame, StreamFlush, StreamAnswer, StreamDropped, StreamError
)


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
            "client": _messages("StreamStart", "StreamFrame", "StreamFlush"),
            "server": _messages("StreamReady", "StreamAnswer", "StreamDropped", "StreamError"),
        }
    },
)
async def ask_for_upgrade() -> Response:
    """Lift frames as they come, over a WebSocket: `ws://.../lift/stream`.

    The client's first message is a `StreamStart`, the server's a `StreamReady`. Then every
    `StreamFrame`, or frame as bytes, gets a `StreamAnswer`, or one as bytes, in the order they
    came. With `on_overload: latest` a `StreamDropped` may come between. With `lag` frames are
    smoothed in time, and a `StreamFlush` asks for the last answers. A bad frame gets a
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
        await websocket.accept(subprotocol_of(websocket))
        try:
            await while_let_in(websocket, _converse(websocket))
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
            project = caller_of(websocket).author.project
            model = engine.models.warm(project, start.model)
            if model is None:
                model = await run_in_threadpool(engine.models.get, project, start.model)
            if start.views is not None:
                check_views(start.views, model.prior, len(start.views))
            following = None
            if start.lag is not None:
                following = await run_in_threadpool(_follow, model.prior, start)
                start = start.model_copy(update={"views": list(following.views)})
            room = None
            if is_room(start.frame, start.up):
                rooms: Rooms = websocket.app.state.rooms
                room = rooms.remembered(model, start.up)
                if room is None:
                    room = await run_in_threadpool(rooms.find, model, start.up)
            conversation = _Conversation(websocket, engine, settings, start, model, room, following)
            await websocket.send_text(conversation.ready())
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
        following: Following | None,
    ) -> None:
        self._websocket, self._engine, self._settings = websocket, engine, settings
        self._start, self._model, self._room = start, model, room
        self._prior = prior = model.prior
        self._refine = start.refine or prior.config.refine
        self._continuity = start.continuity and self._refine != "off" and prior.cameras is not None
        self._latest = start.on_overload == "latest"
        self._smoothed = self._clock = None
        if following is not None:
            self._clock = FilmClock(start.fps)
            self._smoothed = SmoothedFrames(
                engine,
                websocket.app.state.lift_bodies,
                model,
                following,
                self._refine,
                continuity=self._continuity,
            )
        one = self._latest or self._continuity or following is not None
        self._at_a_time = 1 if one else FRAMES_IN_HAND
        self._arrived: deque[Frame] = deque()
        self._asked: deque[tuple[Frame, _Answer | None]] = deque()
        self._previous: LiftedFrames | None = None
        self._something_asked = asyncio.Event()
        self._something_answered = asyncio.Event()

    def ready(self) -> str:
        """Return the first message of the server."""
        ready = StreamReady(
            model=self._model.id,
            keypoints=self._prior.keypoints_per_frame,
            views=self._start.views,
            refine=self._refine,
            on_overload=self._start.on_overload,
            continuity=self._continuity,
            frame=self._start.frame,
            up=self._start.up,
            lag=self._start.lag,
            fps=self._start.fps,
            seen_bytes=seen_bytes(self._prior.keypoints_per_frame),
            limits=StreamLimits(
                message_bytes=self._settings.max_stream_bytes,
                frames_in_hand=FRAMES_IN_HAND,
                idle_seconds=self._settings.stream_idle_seconds,
            ),
        )
        return ready.model_dump_json(exclude={"lag", "fps"} if ready.lag is None else None)

    async def read(self, silence: asyncio.Timeout) -> None:
        """Take frames as they arrive, as many as may be in hand, until the client leaves."""
        now, patience = asyncio.get_running_loop().time, self._settings.stream_idle_seconds
        while True:
            silence.reschedule(now() + patience)
            message = await _receive(self._websocket)
            frame = read_frame(
                message, self._prior, self._room, self._start.views, self._settings, self._clock
            )
            await self._count(frame)
            self._arrived.append(frame)
            self._ask()
            if self._latest:
                self._drop_stale()
            while self._is_full():
                self._something_answered.clear()
                await self._something_answered.wait()

    async def _count(self, frame: Frame) -> None:
        """Count a frame among those that the key may have lifted in a second."""
        rates: Rates = self._websocket.app.state.rates
        if frame.capture is None:
            return
        try:
            await rates.take_frames(caller_of(self._websocket), 1)
        except ApiError as error:
            frame.error = error

    def _is_full(self) -> bool:
        if self._latest:
            arrived = self._arrived
            dropping = bool(arrived) and len(arrived[-1].dropped) >= MAX_DROPPED
            return dropping or len(arrived) >= FRAMES_IN_HAND
        return len(self._arrived) + len(self._asked) >= FRAMES_IN_HAND

    def _drop_stale(self) -> None:
        """Let the newest frame take the place of one that waits, unless a flush parts them."""
        while len(self._arrived) > 1 and not self._arrived[-1].flush | self._arrived[-2].flush:
            newest, stale = self._arrived.pop(), self._arrived.pop()
            if stale.sequence is not None:
                stale.dropped.append(stale.sequence)
            newest.dropped = stale.dropped
            self._arrived.append(newest)

    def _ask(self) -> None:
        """Ask for the lifts of frames that have arrived, as many as may be asked for at a time."""
        while self._arrived and len(self._asked) < self._at_a_time:
            frame = self._arrived.popleft()
            self._asked.append((frame, self._lift(frame)))
            self._something_asked.set()

    def _lift(self, frame: Frame) -> _Answer | None:
        if frame.error is not None:
            return None
        if self._smoothed is not None:
            return asyncio.ensure_future(self._smoothed.take(frame))
        assert frame.capture is not None  # noqa: S101
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
        while True:
            while not self._asked:
                self._something_asked.clear()
                await self._something_asked.wait()
            frame, answer = self._asked[0]
            answered = [] if answer is None else await answer
            if isinstance(answered, LiftedFrames):
                if self._continuity:
                    self._previous = answered
                answered = [(frame, answered)]
            messages = [(frame, self._message(frame, lift)) for frame, lift in answered]
            if frame.error is not None:
                messages = [(frame, _error_text(frame.error, frame.sequence))]
            self._asked.popleft()
            self._ask()
            self._something_answered.set()
            for frame, message in messages:
                await self._send(frame, message)

    def _message(self, frame: Frame, lift: LiftedFrames) -> str | bytes:
        if self._room is not None:
            lift = self._room.place(lift, self._start.views)
        return write_answer(frame, lift, self._prior)

    async def _send(self, frame: Frame, message: str | bytes) -> None:
        if frame.dropped:
            notice = {"type": "dropped", "sequences": frame.dropped}
            await self._websocket.send_text(orjson.dumps(notice).decode())
        form = "text" if isinstance(message, str) else "bytes"
        await self._websocket.send({"type": "websocket.send", form: message})

    def give_up(self) -> None:
        """Leave the engine's queue."""
        for _, answer in self._asked:
            if answer is not None:
                answer.cancel()


def _follow(prior: FittedPrior, start: StreamStart) -> Following:
    assert start.lag is not None  # noqa: S101
    if not prior.smooths:
        raise invalid(
            "/lag",
            "expected no lag: this model does not smooth in time. Fit it to a dataset with `fps` "
            "or `times`, whose frames are near enough in time to separate noise from motion; or "
            "leave `lag` out",
        )
    return prior.follow(views=start.views, lag=start.lag)


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
        found = json_object(message)
        check_bounds(found, StreamStart)
        start = StreamStart.model_validate(found)
        refuse_converted(found, start)
        return start
    except ValidationError as error:
        raise from_validation(error, StreamStart) from error


def _error_text(error: ApiError, sequence: int | None) -> str:
    return StreamError(
        sequence=sequence,
        code=error.code,
        detail=error.detail,
        errors=[FieldError(pointer=pointer, detail=detail) for pointer, detail in error.errors],
    ).model_dump_json()
