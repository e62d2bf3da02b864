"""What comes by a connection is bounded, in bytes and in time, even before there is a request."""

import select
import socket
import time
from collections.abc import Iterator

import httpx2
import orjson
import pytest

from service.settings import Settings
from tests.service.conftest import JSON, MIB, served
from tests.service.http.test_overload import begin
from tests.waiting import wait_for

KIB = 1024
PATIENCE = 1.0  # seconds


@pytest.fixture(scope="module")
def hasty(settings: Settings) -> Iterator[httpx2.Client]:
    """Serve clients of whom none may dawdle; there is room for two large bodies."""
    given = {
        "request_seconds": PATIENCE,
        "max_body_bytes": 3 * 128 * KIB,
        "max_pending_bytes": 4 * 128 * KIB,
    }
    with served(settings.model_copy(update=given)) as http:
        yield http


def connect(http: httpx2.Client) -> socket.socket:
    connection = socket.create_connection((http.base_url.host, http.base_url.port or 0))
    connection.settimeout(20)
    return connection


def read_answer(connection: socket.socket) -> tuple[int | None, bytes]:
    """Read until the server hangs up; return the status of the first answer, and all of it."""
    pieces = []
    try:
        while piece := connection.recv(64 * KIB):
            pieces.append(piece)
    except ConnectionError:  # what was still unread of us can take the end along
        pass
    whole = b"".join(pieces)
    return (int(whole.split()[1]) if whole else None), whole


def flood(connection: socket.socket, start: bytes, piece: bytes, total: int = 8 * MIB) -> int:
    """Send the piece again and again until the server hangs up; return how much it took."""
    sent = 0
    try:
        connection.sendall(start)
        while sent < total:
            connection.sendall(piece)
            sent += len(piece)
    except ConnectionError:
        pass
    return sent


GET = b"GET /version HTTP/1.1\r\nHost: localhost\r\n"
POST = b"POST /lift HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
CHUNKED = POST + b"Transfer-Encoding: chunked\r\n\r\n"


@pytest.mark.parametrize(
    ("start", "piece"),
    [
        (GET, b"X-Many: %s\r\n" % (b"x" * 1000)),
        (GET + b"X-Long: ", b"x" * 1000),
        (b"GET /", b"x" * 1000),
        (b"", b"\r\n" * 500),
        (CHUNKED + b"2\r\n{}\r\n0\r\n", b"X-Trailer: %s\r\n" % (b"x" * 1000)),
        (CHUNKED + b"2;", b"x" * 1000),
    ],
    ids=["many headers", "a long one", "a long path", "blank lines", "trailers", "extensions"],
)
def test_what_is_no_body_is_bounded(hasty: httpx2.Client, start: bytes, piece: bytes) -> None:
    with connect(hasty) as connection:
        sent = flood(connection, start, piece)
        status, whole = read_answer(connection)
    assert sent < 7 * MIB  # most of which waits in the buffers of the two sockets
    if start.startswith(b"GET") and status is not None:
        assert status == 431
        assert b"head_too_large" in whole
    assert hasty.get("/health/live").status_code == 200


def test_a_head_that_comes_at_once_is_bounded(hasty: httpx2.Client) -> None:
    with connect(hasty) as connection:
        connection.sendall(GET + b"X-Long: %s\r\n\r\n" % (b"x" * 70 * KIB))
        status, whole = read_answer(connection)
    assert status == 431
    assert b"application/problem+json" in whole
    assert orjson.loads(whole.partition(b"\r\n\r\n")[2])["code"] == "head_too_large"
    fits = hasty.get("/version", headers={"X-Long": "x" * 60 * KIB})
    assert fits.status_code == 200


def test_what_is_no_http_is_a_problem_too(hasty: httpx2.Client) -> None:
    with connect(hasty) as connection:
        connection.sendall(b"What is this?\r\n\r\n")
        status, whole = read_answer(connection)
    assert status == 400
    assert orjson.loads(whole.partition(b"\r\n\r\n")[2])["code"] == "malformed_request"


@pytest.mark.parametrize("begun", [b"", b"GET /ver", GET, b"\r\n"])
def test_a_head_has_its_time(hasty: httpx2.Client, begun: bytes) -> None:
    with connect(hasty) as connection:
        started = time.monotonic()
        connection.sendall(begun)
        status, _ = read_answer(connection)
        took = time.monotonic() - started
    assert PATIENCE / 2 < took < 10
    assert status == (408 if b"GET" in begun else None)


def test_bytes_now_and_then_give_a_head_no_more_time(hasty: httpx2.Client) -> None:
    with connect(hasty) as connection:
        started = time.monotonic()
        connection.sendall(GET)
        connection.setblocking(False)
        while time.monotonic() - started < 20:
            try:
                connection.sendall(b"X")
                if not connection.recv(KIB):
                    break
            except BlockingIOError:
                time.sleep(0.05)
            except ConnectionError:
                break
    assert time.monotonic() - started < 10


def test_a_body_that_stops_gives_its_room_up(hasty: httpx2.Client) -> None:
    """As three uploads from a network that is gone, which had every large body refused."""
    large = b'{"model": "mdl_none"' + b" " * 100 * KIB + b', "frames": []}'

    def is_overloaded() -> bool:
        return hasty.post("/lift", content=large, headers=JSON).status_code == 503

    def held() -> list[socket.socket] | None:
        connections = [begin(hasty, sent=127 * KIB, promised=200 * KIB) for _ in range(3)]
        while not select.select(connections, [], [], 0)[0]:
            if is_overloaded():
                return connections
        for connection in connections:
            connection.close()
        return None

    for connection in wait_for(held, "the room to be full"):
        with connection:
            connection.settimeout(20)
            status, whole = read_answer(connection)
        assert status == 408
        assert b'"idle"' in whole
    assert not is_overloaded()


def test_a_body_must_come_at_some_pace(hasty: httpx2.Client) -> None:
    """A byte now and then holds no room."""
    connection = begin(hasty, sent=100 * KIB, promised=200 * KIB)
    started = time.monotonic()
    connection.setblocking(False)
    answer = b""
    while time.monotonic() - started < 20 and not answer:
        try:
            connection.sendall(b" ")
            answer = connection.recv(KIB)
        except BlockingIOError:
            time.sleep(0.05)
    connection.close()
    assert answer.startswith(b"HTTP/1.1 408 ")


def test_who_is_slow_but_steady_is_waited_for(hasty: httpx2.Client) -> None:
    """It takes three times as long as silence may last."""

    def slowly() -> Iterator[bytes]:
        for _ in range(12):
            yield b" " * 2 * KIB
            time.sleep(PATIENCE / 4)
        yield b"{}"

    assert hasty.post("/lift", content=slowly(), headers=JSON).status_code == 422


def test_who_reads_nothing_is_left(hasty: httpx2.Client) -> None:
    """A download that nobody takes holds its connection no longer than three times the patience."""
    with connect(hasty) as connection:
        connection.sendall((GET.replace(b"/version", b"/openapi.json") + b"\r\n") * 400)
        select.select([connection], [], [], 20)  # the server's patience runs from now on
        time.sleep(PATIENCE * 8)
        taken = 0
        try:
            while piece := connection.recv(64 * KIB):
                taken += len(piece)
        except ConnectionError:
            pass
    # What the two sockets had taken in by then still comes.
    assert taken < 300 * len(hasty.get("/openapi.json").content)
