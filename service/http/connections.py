"""Connections, with bounds on what comes by them outside of bodies, and on silence."""

import asyncio
from collections.abc import Callable
from contextvars import copy_context
from typing import Any

from starlette.responses import Response
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from service.http.errors import ApiError
from service.http.peers import Peer
from service.http.request_ids import HEADER, given_or_new
from service.http.safe_headers import made_safe
from worker.logs import request_id

MAX_HEAD_BYTES = 64 * 1024
# Between requests. Proxies keep theirs for 60 s, as a rule, and a request that they
# send as we close one is answered 502.
KEEP_ALIVE_SECONDS = 75
READING_PATIENCE = 3  # times as long as for a head: people page through a download


class _HeadTooLarge(Exception):  # noqa: N818 (raised through the parser, which wraps it)
    pass


class Reading:
    """Watches whether a client goes on reading; one that reads nothing for long is left."""

    def __init__(self, loop: asyncio.AbstractEventLoop, seconds: float) -> None:
        self._loop, self._patience = loop, READING_PATIENCE * seconds
        self._timer: asyncio.TimerHandle | None = None

    def watch(self, transport: asyncio.Transport, left: int = -1) -> None:
        """Leave the client if it has read nothing since ``left`` bytes waited for it."""
        self.stop()
        waiting = transport.get_write_buffer_size()
        if waiting == left:
            transport.abort()
            return
        self._timer = self._loop.call_later(self._patience, self.watch, transport, waiting)

    def stop(self) -> None:
        """Watch no longer."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class Connection(HttpToolsProtocol):
    """Speaks HTTP as uvicorn does, within bounds that uvicorn leaves open.

    A head (the request line and its headers) has at most `MAX_HEAD_BYTES`, and so has whatever else
    is no body: trailers, extensions of chunks, blank lines. It comes within ``seconds`` of the
    connection, or of its first byte. A client that reads nothing of its answer for three times as
    long is left. Bodies are bounded by :class:`service.http.body_bytes.BodyLimit`.
    """

    def __init__(
        self,
        *arguments: Any,
        seconds: float,
        on_refusal: Callable[[int, str], None],
        **more: Any,
    ) -> None:
        """Give each step of a client ``seconds``; ``on_refusal`` takes status and code of problems.

        These are problems of what is no request yet, which the application never sees.
        """
        super().__init__(*arguments, **more)
        self._seconds, self._on_refusal = seconds, on_refusal
        self._in_head = self._got_on = False
        self._bytes_apart = 0  # since a body's last bytes, or the begin or end of a head
        self._head_timer: asyncio.TimerHandle | None = None
        self._reading = Reading(self.loop, seconds)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request; every request has ``peer`` in the state of its scope."""
        super().connection_made(transport)
        # This one's own, of which each request and a WebSocket's protocol take a copy.
        self.app_state = {**self.app_state, "peer": Peer(transport.get_extra_info("socket"))}
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        self._stop_waiting()
        self._reading.stop()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what came; refuse too much that is no body."""
        self._got_on = False
        super().data_received(data)
        self._bytes_apart = 0 if self._got_on else self._bytes_apart + len(data)
        if self._bytes_apart > MAX_HEAD_BYTES:
            self._refuse(_too_large())
        self._await_head()

    def on_message_begin(self) -> None:
        """Begin a head."""
        super().on_message_begin()
        self._in_head = self._got_on = True

    def on_headers_complete(self) -> None:
        """End a head."""
        self._in_head, self._got_on = False, True
        self._stop_waiting()
        if len(self.url) + sum(len(n) + len(v) for n, v in self.headers) > MAX_HEAD_BYTES:
            raise _HeadTooLarge
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a part of a body."""
        self._got_on = True
        super().on_body(body)

    def handle_websocket_upgrade(self) -> None:
        """Leave the connection to the protocol of WebSockets."""
        self._stop_waiting()
        self._reading.stop()
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        """Return the reason why the parser stopped, as a problem."""
        large = len(self.url) + sum(len(n) + len(v) for n, v in self.headers or ()) > MAX_HEAD_BYTES
        self._refuse(_too_large() if large else ApiError("malformed_request", msg))

    def pause_writing(self) -> None:
        """Watch whether the client goes on reading."""
        super().pause_writing()
        self._reading.watch(self.transport)

    def resume_writing(self) -> None:
        """Go on writing."""
        self._reading.stop()
        super().resume_writing()

    def _is_answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _await_head(self) -> None:
        """Have the time for a head run, unless it does, or a request is being answered."""
        theirs = self.transport.get_protocol() is not self
        if self._head_timer or theirs or self.transport.is_closing() or self._is_answering():
            return
        self._head_timer = self.loop.call_later(self._seconds, self._give_up)

    def _give_up(self) -> None:
        self._head_timer = None
        if self._in_head:
            detail = f"expected the whole head of the request within {self._seconds:g} s"
            self._refuse(ApiError("idle", detail))
        else:
            self.transport.close()

    def _stop_waiting(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _refuse(self, error: ApiError) -> None:
        """Answer with a problem, unless another answer is on its way, and close the connection."""
        if self.transport.is_closing():
            return
        if not self._is_answering():
            identifier = given_or_new(self.headers or ())
            response = copy_context().run(_problem, error, identifier)
            headers = [
                *made_safe(response.raw_headers),
                (HEADER, identifier.encode()),
                (b"connection", b"close"),
            ]
            lines = [name + b": " + value + b"\r\n" for name, value in headers]
            head = STATUS_LINE[response.status_code] + b"".join(lines) + b"\r\n"
            self.transport.write(head + bytes(response.body))
            self._on_refusal(response.status_code, error.code)
        self.transport.close()


def _problem(error: ApiError, identifier: str) -> Response:
    request_id.set(identifier)
    return error.response()


def _too_large() -> ApiError:
    return ApiError("head_too_large", f"Headers may have {MAX_HEAD_BYTES} bytes at most.")
