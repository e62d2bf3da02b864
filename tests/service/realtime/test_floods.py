"""What a client of a stream sends keeps nobody waiting, and is read no faster than it reads."""

import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx2
import numpy as np
import orjson
import pytest
from websockets.frames import CloseCode
from websockets.server import ServerProtocol

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from tests.processes import growth
from tests.service.conftest import BYTES, MIB, Live, served
from tests.service.http.test_bounds import watched
from tests.service.realtime.conftest import Answer, as_bytes, read_bytes, started

AT_ONCE = 256 * 1024  # bytes that a connection is read by at most
ATTEMPTS = 3  # to flood while no other test keeps the processors busy
TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
HANDSHAKE = (
    b"GET /lift/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def frame(kind: int, data: bytes = b"", *, last: bool = True) -> bytes:
    """Return a frame as clients send them, masked with zeros."""
    head = struct.pack("!BB", kind | 0x80 * last, 0x80 | min(len(data), 126))
    return head + (struct.pack("!H", len(data)) if len(data) > 125 else b"") + bytes(4) + data


FLOODS = {
    "pings": frame(PING),
    "long pings": frame(PING, bytes(125)),
    "pongs": frame(PONG),
    "messages": frame(BINARY),
    "texts": frame(TEXT, b"{}"),
}


@contextmanager
def stream(http: httpx2.Client, model: str) -> Iterator[socket.socket]:
    """Open a stream of which nothing is read any more."""
    place = (http.base_url.host, http.base_url.port or 0)
    with socket.create_connection(place) as connection:
        connection.settimeout(60)
        connection.sendall(HANDSHAKE)
        assert connection.recv(64 * 1024).startswith(b"HTTP/1.1 101 ")
        connection.sendall(frame(TEXT, orjson.dumps({"model": model})))
        assert b'"ready"' in connection.recv(64 * 1024)
        yield connection


def in_one_go(data: bytes) -> float:
    """Return how many seconds it takes to read frames without a pause."""
    protocol = ServerProtocol()
    protocol.state = protocol.state.OPEN
    protocol.receive_data(HANDSHAKE)
    began = time.perf_counter()
    protocol.receive_data(data)
    assert len(protocol.events_received()) > 1000
    return time.perf_counter() - began


@pytest.fixture(scope="module")
def figure(live: Live, weights: bytes) -> str:
    return str(live.http.post("/models", content=weights, headers=BYTES).json()["id"])


@pytest.mark.parametrize("name", FLOODS)
def test_floods_keep_nobody_waiting(live: Live, figure: str, name: str) -> None:
    """A flood that keeps others waiting does so each time; another test may do so once."""
    assert any(waits_are_short(live, figure, FLOODS[name]) for _ in range(ATTEMPTS))


def waits_are_short(live: Live, figure: str, flood: bytes) -> bool:
    """Return whether others waited no longer than it takes to read what is read at once."""
    piece = flood * (AT_ONCE // len(flood))
    alone = in_one_go(piece)
    with (
        watched(live) as waits,
        stream(live.http, figure) as connection,
        growth(live.process.pid, b"service.app") as grew,
    ):
        connection.setblocking(False)
        ends = time.monotonic() + 2
        while time.monotonic() < ends and select.select([], [connection], [], 0.5)[1]:
            connection.send(piece)
    assert grew[0] < 32 * MIB
    return max(waits) < max(alone, 0.5)


def test_a_client_that_does_not_read_is_not_read_from(settings: Settings, model: str) -> None:
    piece = frame(PING, bytes(125)) * 1000
    hasty = settings.model_copy(update={"request_seconds": 0.5})
    with served(hasty) as http, stream(http, model) as connection:
        connection.setblocking(False)
        sent = 0
        while select.select([], [connection], [], 1)[1]:
            sent += connection.send(piece)
            assert sent < 64 * MIB
        # And it is left, for others to have its place.
        connection.setblocking(True)
        connection.settimeout(60)
        with pytest.raises(ConnectionError):
            connection.sendall(piece * 1000)


def test_messages_have_a_bounded_number_of_fragments(http: httpx2.Client, model: str) -> None:
    with stream(http, model) as connection:
        connection.sendall(frame(TEXT, last=False) + frame(0, last=False) * 2000)
        answer = connection.recv(64 * 1024)
    assert answer[0] == 0x80 | CLOSE
    assert int.from_bytes(answer[2:4]) == CloseCode.MESSAGE_TOO_BIG


def answers(connection: socket.socket, count: int) -> list[Answer]:
    """Read so many answers in bytes; pongs may come between."""
    found: list[Answer] = []
    data = b""
    while len(found) < count:
        data += connection.recv(64 * 1024)
        while len(data) >= 4:
            short = data[1] < 126
            start = 2 if short else 4
            end = start + (data[1] if short else int.from_bytes(data[2:4]))
            if len(data) < end:
                break
            if data[0] & 15 == BINARY:
                found.append(read_bytes(data[start:end]))
            data = data[end:]
    return found


def test_what_comes_at_once_is_answered_in_order(
    http: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    """With pings between, and messages in fragments."""
    messages = [as_bytes(number, seen) for number, seen in enumerate(capture.keypoints)]
    pieces = [
        frame(PING, b"?") + frame(BINARY, message[:100], last=False) + frame(0, message[100:])
        for message in messages
    ]
    with stream(http, model) as connection:
        connection.sendall(b"".join(pieces))
        found = answers(connection, len(messages))
    with started(http, model) as one_by_one:
        for number, (message, answer) in enumerate(zip(messages, found, strict=True)):
            one_by_one.send(message)
            expected = read_bytes(one_by_one.recv(timeout=300))
            assert answer.sequence == expected.sequence == number
            np.testing.assert_allclose(answer.points, expected.points, rtol=1e-4, atol=1e-4)
