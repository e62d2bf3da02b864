"""Identifiers of requests: taken from ``X-Request-Id`` or made, answered, and in every log line."""

import os
from collections.abc import Iterable
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request, Response

from worker.logs import REQUEST_ID, request_id

HEADER = b"x-request-id"
# What begins an answer, of handshakes too.
STARTS = ("http.response.start", "websocket.accept", "websocket.http.response.start")


class RequestIds:
    """Gives every request an identifier, and every answer the header that names it.

    The outermost of all, so that no answer is without it. Nothing is reset afterwards: each request
    has a task, and so a context, of its own, and what the server logs of its end belongs to it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        identifier = given_or_new(scope["headers"])
        request_id.set(identifier)
        header = (HEADER, identifier.encode())

        async def send_with_header(message: Message) -> None:
            if message["type"] in STARTS:
                message["headers"] = [*message.get("headers", ()), header]
            await send(message)

        await self._app(scope, receive, send_with_header)


def given_or_new(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the request's own identifier if it has one that can be taken, else a new one."""
    for name, value in headers:
        if name == HEADER:
            given = value.decode("latin-1")
            if REQUEST_ID.fullmatch(given):
                return given
            break
    return os.urandom(16).hex()


class WebSocketConnection(WebSocketsSansIOProtocol):
    """Speaks WebSocket as uvicorn does; handshakes that this refuses have an identifier, too."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._identifier = given_or_new(())
        accept, reject = self.conn.accept, self.conn.reject

        def accept_named(request: Request) -> Response:
            given = request.headers.get_all(HEADER.decode())
            self._identifier = given_or_new((HEADER, each.encode("latin-1")) for each in given)
            return accept(request)

        def reject_named(*why: Any) -> Response:
            response = reject(*why)
            response.headers[HEADER.decode()] = request_id.get() or self._identifier
            return response

        self.conn.accept = accept_named  # type: ignore[method-assign]
        self.conn.reject = reject_named  # type: ignore[method-assign]
