"""Identifiers of requests: taken from ``X-Request-Id`` or made, answered, and in every log line."""

import random
import time
from collections.abc import Iterable
from http import HTTPStatus
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request, Response

from service.http.metrics import SWITCHED, Metrics
from service.http.safe_headers import HEADERS
from worker.logs import REQUEST_ID, request_id

HEADER = b"x-request-id"
# What begins an answer, of handshakes too.
STARTS = ("http.response.start", "websocket.accept", "websocket.http.response.start")


class Watched:
    """Gives every request an identifier, puts it into a header of the answer, and counts both.

    It is the outermost middleware, so that no answer lacks the header. The identifier is not reset
    afterwards: each request has its own task, and so its own context, and the server's log lines
    about its end belong to it.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        began, status = time.perf_counter(), 0
        identifier = given_or_new(scope["headers"])
        request_id.set(identifier)
        scope.setdefault("state", {})["request_id"] = identifier
        header = (HEADER, identifier.encode())

        async def send_with_header(message: Message) -> None:
            nonlocal status
            if message["type"] in STARTS:
                message["headers"] = [*message.get("headers", ()), header]
                status = message.get("status", SWITCHED)
                if status == SWITCHED:
                    self._metrics.opened()
            await send(message)

        try:
            await self._app(scope, receive, send_with_header)
        finally:
            # Without a status there was no answer, or a handshake was refused by closing it.
            status = status or (500 if scope["type"] == "http" else 403)
            self._metrics.answered(scope, status, time.perf_counter() - began)


def given_or_new(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the request's own identifier if it has one that can be taken, else a new one."""
    for name, value in headers:
        if name == HEADER:
            given = value.decode("latin-1")
            if REQUEST_ID.fullmatch(given):
                return given
            break
    return f"{random.getrandbits(128):032x}"


class NamedWebSocket(WebSocketsSansIOProtocol):
    """Speaks WebSocket as uvicorn does; handshakes that this refuses have an identifier, too."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._identifier = given_or_new(())
        accept, reject = self.conn.accept, self.conn.reject

        def accept_named(request: Request) -> Response:
            given = request.headers.get_all(HEADER.decode())
            self._identifier = given_or_new((HEADER, each.encode("latin-1")) for each in given)
            return accept(request)

        def reject_named(status: HTTPStatus | int, text: str) -> Response:
            response = reject(status, text)
            response.headers[HEADER.decode()] = request_id.get() or self._identifier
            for name, value in HEADERS.items():
                response.headers.setdefault(name.decode(), value.decode())
            return response

        self.conn.accept = accept_named  # type: ignore[method-assign]
        self.conn.reject = reject_named  # type: ignore[method-assign]
