"""A body over the limit is refused while it streams, before it is in memory."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from service.settings import Settings
from tests.processes import command_of, descendants
from tests.service.conftest import BYTES, JSON, MIB, Live, problem

pytestmark = pytest.mark.usefixtures("unchanged")


class Chunks:
    """A body without a length, which counts what was taken of it."""

    def __init__(self, total: int, size: int = 64 * 1024) -> None:
        self.taken, self._total, self._size = 0, total, size

    def __iter__(self) -> Iterator[bytes]:
        while self.taken < self._total:
            self.taken += self._size
            yield b" " * self._size


@pytest.mark.parametrize("url", ["/datasets", "/datasets/ds_x/frames", "/lift", "/models"])
def test_a_length_over_the_limit_is_refused_unread(api: TestClient, url: str) -> None:
    for headers in (BYTES, JSON, {"Content-Type": "multipart/form-data; boundary=x"}):
        response = api.post(url, content=b"x" * (4 * MIB + 1), headers=headers)
        assert "4194304 bytes at most" in problem(response, 413, "body_too_large")


@pytest.mark.parametrize("kind", ["application/octet-stream", "multipart/form-data; boundary=x"])
def test_a_stream_over_the_limit_is_refused(api: TestClient, kind: str) -> None:
    start = b'--x\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n\r\n'

    def body() -> Iterator[bytes]:
        yield start
        yield from Chunks(5 * MIB)

    response = api.post("/datasets", content=body(), headers={"Content-Type": kind})
    problem(response, 413, "body_too_large")


def test_json_has_a_limit_of_its_own(api: TestClient, settings: Settings) -> None:
    for url in ("/datasets", "/lift", "/fits"):
        body = b'{"name": "' + b"x" * settings.max_json_bytes + b'"}'
        response = api.post(url, content=body, headers=JSON)
        assert "safetensors" in problem(response, 413, "body_too_large")


def test_at_the_limit_it_is_read(api: TestClient) -> None:
    response = api.post("/datasets", content=b"x" * (4 * MIB), headers=BYTES)
    problem(response, 400, "malformed_body")


@pytest.mark.parametrize("framing", ["content-length", "chunked"])
def test_the_server_does_not_swallow_it(live: Live, framing: str) -> None:
    """Offer 1 GiB to a server that takes 256 MiB, or 64 MiB of JSON."""
    host, port = live.url.removeprefix("http://").split(":")
    head = f"POST /datasets HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\n"
    head += (
        f"Content-Length: {1024 * MIB}\r\n\r\n"
        if framing == "content-length"
        else "Transfer-Encoding: chunked\r\n\r\n"
    )
    block = b" " * MIB
    piece = block if framing == "content-length" else b"%x\r\n%s\r\n" % (MIB, block)
    sent, answer = 0, b""
    with socket.create_connection((host, int(port))) as connection:
        connection.settimeout(30)
        try:
            connection.sendall(head.encode())
            while sent < 1024 * MIB:
                connection.sendall(piece)
                sent += MIB
        except ConnectionError:  # it has answered and hung up
            pass
        try:
            answer = connection.recv(65536)
        except ConnectionError:  # what is still unread when it hangs up can take the answer along
            answer = b""
    assert sent < 120 * MIB
    if answer:
        assert answer.startswith(b"HTTP/1.1 413 ")
        assert b"application/problem+json" in answer
    assert live.get("/health/live") == {"status": "ok"}


def test_a_client_reads_the_refusal(live: Live) -> None:
    body = Chunks(1024 * MIB)
    response = live.http.post("/lift", content=iter(body), headers=JSON)
    problem(response, 413, "body_too_large")
    assert body.taken < 120 * MIB


@pytest.mark.parametrize("piece", [b"[],", b"{},", b"[[],[]],"])
def test_json_that_grows_as_it_is_read_is_refused(api: TestClient, piece: bytes) -> None:
    """Empty lists take two dozen times their length in memory."""
    start = b'{"model": "mdl_none", "keypoints": ['
    body = start + piece * (900_000 // len(piece)) + b"[]]}"
    for url in ("/datasets", "/lift"):
        detail = problem(api.post(url, content=body, headers=JSON), 413, "body_too_large")
        assert "safetensors" in detail


def test_the_memory_for_json_is_bounded(live: Live) -> None:
    """64 MiB of empty lists took 1.5 GB."""
    (pid,) = (pid for pid in descendants(live.process.pid) if b"service.app" in command_of(pid))

    def peak() -> int:
        status = Path(f"/proc/{pid}/status").read_text()
        return 1024 * int(status.partition("VmHWM:")[2].split()[0])

    before = peak()
    body = b'{"keypoints": [' + b"[]," * (20 * MIB) + b"[]]}"
    problem(live.http.post("/datasets", content=body, headers=JSON), 413, "body_too_large")
    assert peak() - before < 400 * MIB
