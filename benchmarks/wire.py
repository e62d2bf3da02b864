"""A lean client: what is timed is the service, so a request costs this side next to nothing."""

import asyncio
from typing import NamedTuple, cast

LENGTH = b"\r\ncontent-length:"


class Answer(NamedTuple):
    """What came back."""

    status: int
    body: bytes


class Connection(asyncio.Protocol):
    """One HTTP/1.1 connection that is kept open. Requests are bytes, made once by `post`.

    The service ends connections on which nothing comes for seconds; then it connects anew.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = host, port
        self._transport: asyncio.Transport | None = None
        self._waiting: asyncio.Future[Answer] | None = None
        self._come = bytearray()
        self._head = self._whole = 0  # lengths, once the head has come

    @classmethod
    async def open(cls, host: str, port: int) -> "Connection":
        """Connect."""
        connection = cls(host, port)
        await connection._connect()
        return connection

    async def _connect(self) -> None:
        self._come, self._whole = bytearray(), 0
        await asyncio.get_running_loop().create_connection(lambda: self, *self._address)

    async def ask(self, request: bytes) -> Answer:
        """Send a request and wait for the whole answer, which must say its length."""
        assert self._transport is not None
        if self._transport.is_closing():
            await self._connect()
        self._waiting = asyncio.get_running_loop().create_future()
        self._transport.write(request)
        return await self._waiting

    def close(self) -> None:
        """Disconnect."""
        assert self._transport is not None
        self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep what writes."""
        self._transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        """Collect an answer; when it is whole, hand it to who waits."""
        self._come += data
        if not self._whole:
            self._head = self._come.find(b"\r\n\r\n") + 4
            if self._head < 4:
                return
            head = bytes(self._come[: self._head]).lower()
            start = head.index(LENGTH) + len(LENGTH)
            self._whole = self._head + int(head[start : head.index(b"\r\n", start)])
        if len(self._come) >= self._whole and self._waiting is not None:
            answer = Answer(int(self._come[9:12]), bytes(self._come[self._head :]))
            self._come, self._whole = bytearray(), 0
            self._waiting.set_result(answer)

    def connection_lost(self, error: Exception | None) -> None:
        """Do not let anyone wait for ever."""
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(error or ConnectionError("the service hung up"))


def post(path: str, body: bytes, *, content: str, accept: str) -> bytes:
    """Return a POST as it goes over the wire."""
    return (
        f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {content}\r\n"
        f"Accept: {accept}\r\nContent-Length: {len(body)}\r\n\r\n"
    ).encode() + body
