"""A way to records and objects that can be closed: what an outage of them looks like."""

import asyncio
import threading
from contextlib import suppress
from typing import Literal

from benchmarks.chaos_parts import free_port

HEAD_BYTES = 64 * 1024
PIECE_BYTES = 64 * 1024

Mode = Literal["open", "refusing", "stalled", "unavailable", "full"]
ANSWERS = {"unavailable": "503 Service Unavailable", "full": "507 Insufficient Storage"}


class Proxy:
    """Passes TCP connections on to a server, as long as its mode is ``open``.

    ``refusing`` ends every connection, ``stalled`` lets nothing through, which are those of an
    outage and of a network that lost its way. ``unavailable`` answers every HTTP request with 503,
    ``full`` those that write with 507. A change of the mode ends the connections that there are,
    save that a stall keeps them.
    """

    def __init__(self, port: int | None = None, *, socket: str | None = None) -> None:
        """Pass connections on to a port of this machine, or to a Unix socket."""
        self.port = free_port()
        self._target, self._socket = port, socket
        self._mode: Mode = "open"
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True).start()
        self._do(asyncio.start_server(self._serve, "127.0.0.1", self.port))

    def turn(self, mode: Mode) -> None:
        """Change the mode."""
        self._do(self._turn(mode))

    def _do(self, work: "asyncio.Future[object] | object") -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()  # type: ignore[arg-type]

    async def _turn(self, mode: Mode) -> None:
        self._mode = mode
        if mode == "stalled":
            self._flowing.clear()
            return
        self._flowing.set()
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        try:
            await self._flowing.wait()
            if self._mode == "open":
                await self._pass_on(reader, writer, b"")
            elif self._mode in ANSWERS:
                await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            self._writers.discard(writer)
            writer.transport.abort()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        if self._mode == "full" and not head.startswith((b"PUT ", b"POST ")):
            one = head.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
            await self._pass_on(reader, writer, one)
            return
        answer = f"HTTP/1.1 {ANSWERS[self._mode]}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
        writer.write(answer.encode())
        await writer.drain()
        with suppress(TimeoutError):  # a client that is cut off as it writes sees no answer
            await asyncio.wait_for(reader.read(HEAD_BYTES), 1)

    async def _pass_on(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, first: bytes
    ) -> None:
        if self._socket is not None:
            opened = asyncio.open_unix_connection(self._socket)
        else:
            opened = asyncio.open_connection("127.0.0.1", self._target)
        back, forth = await opened
        self._writers.add(forth)
        try:
            forth.write(first)
            await asyncio.gather(self._pump(reader, forth), self._pump(back, writer))
        finally:
            self._writers.discard(forth)
            forth.transport.abort()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(PIECE_BYTES):
            await self._flowing.wait()
            writer.write(data)
            await writer.drain()
        with suppress(OSError):
            writer.write_eof()
