"""A lean client: what is timed is the service, so a request costs this side next to nothing."""

import asyncio
from dataclasses import dataclass

BUFFER = 4 * 1024 * 1024  # bytes that may come before the reader pauses the socket


@dataclass(frozen=True)
class Answer:
    """What came back."""

    status: int
    body: bytes


class Connection:
    """One HTTP/1.1 connection that is kept open. Requests are bytes, made once by `post`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def open(cls, host: str, port: int) -> "Connection":
        """Connect."""
        return cls(*await asyncio.open_connection(host, port, limit=BUFFER))

    async def ask(self, request: bytes) -> Answer:
        """Send a request and wait for the whole answer, which must say its length."""
        self._writer.write(request)
        head = await self._reader.readuntil(b"\r\n\r\n")
        lowered = head.lower()
        start = lowered.index(b"\r\ncontent-length:") + 17
        length = int(lowered[start : lowered.index(b"\r\n", start)])
        return Answer(int(head[9:12]), await self._reader.readexactly(length))

    async def close(self) -> None:
        """Disconnect."""
        self._writer.close()
        await self._writer.wait_closed()


def post(path: str, body: bytes, *, content: str, accept: str) -> bytes:
    """Return a POST as it goes over the wire."""
    return (
        f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {content}\r\n"
        f"Accept: {accept}\r\nContent-Length: {len(body)}\r\n\r\n"
    ).encode() + body
