"""WebSockets of `/lift`: how each is opened, what ends it, and what it is then sent."""

import asyncio
import logging
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

from fastapi import WebSocket
from starlette.websockets import WebSocketDisconnect

from service.http.authentication import subprotocol_of
from service.http.dependencies import refuse_if_leaving
from service.http.errors import PROBLEMS, ApiError, FieldError, translated
from service.http.keyring import while_let_in
from service.http.origins import refuse_foreign
from service.http.places import Places
from service.wire.stream_messages import StreamError

CLOSE_CODE = 4000  # plus the status of the problem that ends a stream

logger = logging.getLogger(__name__)


async def serve(
    websocket: WebSocket,
    places: Places,
    work: Callable[[WebSocket], Coroutine[Any, Any, None]],
) -> None:
    """Work for a client until it leaves, its key is revoked, or something goes wrong.

    With all places taken the handshake is refused, as it is to pages of others.
    """
    refusal = _refusal(websocket, places)
    if refusal is not None:
        await websocket.send_denial_response(refusal.response())
        return
    with places.held(websocket):
        await websocket.accept(subprotocol_of(websocket))
        try:
            await while_let_in(websocket, work(websocket))
        except WebSocketDisconnect:
            return
        except Exception as error:
            ending = translated(error)
            if ending.code == "internal_error":
                logger.exception("A stream failed")
            with suppress(WebSocketDisconnect):
                await websocket.send_text(error_text(ending, None))
                await websocket.close(CLOSE_CODE + PROBLEMS[ending.code][0])
        else:
            with suppress(WebSocketDisconnect):  # the client may have left meanwhile
                await websocket.close()


def _refusal(websocket: WebSocket, places: Places) -> ApiError | None:
    """Return why the handshake is refused, if it is."""
    try:
        refuse_foreign(websocket)
        refuse_if_leaving(websocket)
    except ApiError as error:
        return error
    return places.refusal(
        websocket, "As many streams are open as may be; try again when some are closed."
    )


async def beside(work: Coroutine[Any, Any, None], *others: Coroutine[Any, Any, None]) -> None:
    """Do work, and others beside it until it ends; raise what the first of them raises."""
    try:
        async with asyncio.TaskGroup() as tasks:
            running = [tasks.create_task(other) for other in others]
            await work
            for other in running:
                other.cancel()
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def receive(websocket: WebSocket) -> str | bytes:
    """Return the next message; raise ``WebSocketDisconnect`` if there will be none."""
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    text: str | None = message.get("text")
    data: bytes | None = message.get("bytes")
    return text if text is not None else data or b""


def error_text(error: ApiError, sequence: int | None) -> str:
    """Return the message of an error, of a frame or of the stream."""
    return StreamError(
        sequence=sequence,
        code=error.code,
        detail=error.detail,
        errors=[FieldError(pointer=pointer, detail=detail) for pointer, detail in error.errors],
    ).model_dump_json()


def messages(*names: str) -> dict[str, list[dict[str, str]]]:
    """Return the part of the OpenAPI document that names the messages of one side."""
    return {"oneOf": [{"$ref": f"#/components/schemas/{name}"} for name in names]}


def upgrade_required(where: str) -> ApiError:
    """Return the error of a request that is no handshake."""
    return ApiError(
        "upgrade_required",
        f"expected a WebSocket: ask for ws://...{where} with a WebSocket library",
        headers={"Upgrade": "websocket", "Connection": "Upgrade"},
    )
