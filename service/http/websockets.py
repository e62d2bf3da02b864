"""WebSockets, with bounds on what one client keeps the others waiting for, and on silence."""

import asyncio
import time
from typing import Any

from websockets.frames import CloseCode, Frame

from service.http.connections import Reading
from service.http.request_ids import NamedWebSocket

PART_BYTES = 1024
PARTS_SECONDS = 0.005  # of one client, before others have their turn
MOST_FRAGMENTS = 1024  # of a message


class WebSocketConnection(NamedWebSocket):
    """Speaks WebSocket as uvicorn does, within bounds that uvicorn leaves open.

    Input may have many frames of as few as six bytes, so it is processed for a few milliseconds at
    a time. While a message waits for the application, or the client does not read answers or pongs,
    nothing more is read. A message has `MOST_FRAGMENTS` fragments at most. The connection of a
    client that reads nothing for long is closed.
    """

    def __init__(self, *arguments: Any, seconds: float, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._reading = Reading(self.loop, seconds)
        self._came = bytearray()  # and is not worked on yet
        self._going_on: asyncio.Handle | None = None

    def data_received(self, data: bytes) -> None:
        """Take what came, or set it aside."""
        self._came += data
        if self._going_on is None:
            self._go_on()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget what was set aside."""
        self._reading.stop()
        self._came.clear()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait for the client to read."""
        super().pause_writing()
        self._reading.watch(self.transport)

    def resume_writing(self) -> None:
        """Go on."""
        super().resume_writing()
        self._reading.stop()
        self._go_on_soon()

    async def send(self, message: Any) -> None:
        """Send a message; a handshake that was refused with an answer is complete."""
        await super().send(message)
        if self.initial_response is not None and self.close_sent:
            self.handshake_complete = True  # uvicorn logs an error for any that is not

    async def receive(self) -> Any:
        """Return what comes next, and make way for what comes after it."""
        message = await super().receive()
        if (self._came or not self.writable.is_set()) and not self.transport.is_closing():
            self.transport.pause_reading()  # which goes on with each message that is taken
            self._go_on_soon()
        return message

    def handle_cont(self, event: Frame) -> None:
        """Take a fragment; end the connection if there are too many."""
        if len(self.frames) < MOST_FRAGMENTS:
            super().handle_cont(event)
        elif not self.close_sent:
            self.conn.fail(CloseCode.MESSAGE_TOO_BIG, f"over {MOST_FRAGMENTS} fragments")
            self.handle_parser_exception()

    def _may_go_on(self) -> bool:
        waits = self.read_paused or not self.writable.is_set()
        return not (waits or self.transport.is_closing())

    def _go_on_soon(self) -> None:
        if self._going_on is None:
            self._going_on = self.loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        """Work on what came for a moment; read on when nothing of it is left."""
        self._going_on = None
        ends = time.monotonic() + PARTS_SECONDS
        while self._came and self._may_go_on() and time.monotonic() < ends:
            part = bytes(self._came[:PART_BYTES])
            del self._came[:PART_BYTES]
            super().data_received(part)
        if self.transport.is_closing():
            return
        if not self._may_go_on():
            self.transport.pause_reading()
        elif self._came:
            self.transport.pause_reading()
            self._go_on_soon()
        else:
            self.transport.resume_reading()
