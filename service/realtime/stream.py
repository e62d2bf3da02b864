"""A stream of frames over a WebSocket, each answered before the next tick of the cameras."""

import asyncio

from fastapi import APIRouter, WebSocket
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError
from starlette.responses import Response

from models.lifting.fitted_prior import FittedPrior
from models.lifting.observing import Following
from service.http.errors import ApiError, from_validation, invalid, problems
from service.http.json_bounds import check_bounds
from service.http.keyring import caller_of
from service.http.operations import register
from service.realtime.conversation import Conversation
from service.realtime.engine import Engine
from service.realtime.frames import check_views
from service.realtime.open_streams import OpenStreams
from service.realtime.rooms import Rooms
from service.realtime.sockets import beside, messages, receive, serve, upgrade_required
from service.realtime.stream_frames import json_object
from service.settings import Settings
from service.wire.json_kinds import refuse_converted
from service.wire.rooms import is_room
from service.wire.stream_messages import (
    StreamAnswer,
    StreamDropped,
    StreamError,
    StreamFlush,
    StreamFrame,
    StreamReady,
    StreamStart,
)

router = APIRouter(tags=["lift"])

register(
    StreamStart, StreamReady, StreamFrame, StreamFlush, StreamAnswer, StreamDropped, StreamError
)


@router.get(
    "/lift/stream",
    operation_id="stream_lifts",
    status_code=101,
    response_class=Response,
    responses=problems("upgrade_required", "origin_not_allowed")
    | {101: {"description": "The protocol is now WebSocket."}},
    openapi_extra={
        "x-websocket": {
            "client": messages("StreamStart", "StreamFrame", "StreamFlush"),
            "server": messages("StreamReady", "StreamAnswer", "StreamDropped", "StreamError"),
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
    raise upgrade_required("/lift/stream")


@router.websocket("/lift/stream")
async def stream(websocket: WebSocket) -> None:
    """Talk to one client until it leaves, or falls silent, or its model is gone."""
    await serve(websocket, websocket.app.state.streams, _converse)


async def _converse(websocket: WebSocket) -> None:
    engine: Engine = websocket.app.state.engine
    open_streams: OpenStreams = websocket.app.state.open_streams
    settings: Settings = websocket.app.state.settings
    # Until a stream has begun it has as long as the head of a request: places are few.
    patience = min(settings.request_seconds, settings.stream_idle_seconds)
    try:
        async with asyncio.timeout(patience) as silence:
            start = _read_start(await receive(websocket))
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
            patience = settings.stream_idle_seconds
            conversation = Conversation(websocket, engine, settings, start, model, room, following)
            await websocket.send_text(conversation.ready())
            try:
                with open_streams.listed(conversation.shown):
                    await beside(conversation.read(silence), conversation.write())
            finally:
                conversation.give_up()
    except TimeoutError:
        raise ApiError("idle", f"expected a message within {patience:g} s") from None


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
