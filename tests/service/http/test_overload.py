"""What is in hand is bounded: beyond that clients get 503, and places are freed."""

import os
import select
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import httpx2
import numpy as np
import orjson
import pytest

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from tests.processes import command_of, descendants
from tests.service.conftest import (
    BYTES,
    JSON,
    frames_of,
    problem,
    served,
    to_npz,
    to_safetensors,
)
from tests.service.slow_files import SLOW_FRAMES, slow_to_read
from tests.waiting import wait_for

KIB = 1024
PLACES = 4  # small bodies that there is room for


@pytest.fixture(scope="module")
def narrow(settings: Settings) -> Iterator[httpx2.Client]:
    room = {"max_body_bytes": 128 * KIB, "max_pending_bytes": PLACES * 64 * KIB}
    with served(settings.model_copy(update=room)) as http:
        yield http


def begin(http: httpx2.Client, sent: int, promised: int) -> socket.socket:
    """Send the first part of a body and leave it at that."""
    return send(http, "/lift", "application/json", b" " * sent, promised)


def send(http: httpx2.Client, url: str, kind: str, body: bytes, length: int) -> socket.socket:
    """Send a request and do not wait for an answer."""
    connection = socket.create_connection((http.base_url.host, http.base_url.port or 0))
    head = f"POST {url} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\n"
    head += f"Content-Length: {length}"
    connection.sendall(head.encode() + b"\r\n\r\n" + body)
    return connection


def refused(http: httpx2.Client, body: bytes) -> bool:
    response = http.post("/lift", content=body, headers=JSON)
    if response.status_code != 503:
        assert response.status_code == 200, response.text
        return False
    problem(response, 503, "overloaded")
    assert int(response.headers["retry-after"]) > 0
    return True


def hold(
    http: httpx2.Client, probe: bytes, begin: Callable[[], list[socket.socket]]
) -> list[socket.socket]:
    """Return requests that leave no room for the probe; begin them anew if it came before them."""

    def held() -> list[socket.socket] | None:
        connections = begin()
        while not select.select(connections, [], [], 0)[0]:
            if refused(http, probe):
                return connections
        for connection in connections:
            connection.close()
        return None

    found: list[socket.socket] = wait_for(held, "the room to be full")
    return found


def test_beyond_the_room_requests_are_refused_until_somebody_leaves(
    narrow: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    body = orjson.dumps({"model": model, "frames": frames_of(capture.keypoints[:1])})
    waiting = hold(
        narrow, body, lambda: [begin(narrow, sent=10, promised=1000) for _ in range(PLACES)]
    )
    assert narrow.get("/health/live").status_code == 200
    assert refused(narrow, body)
    waiting.pop().close()
    wait_for(lambda: not refused(narrow, body), "the place of the one who left")
    for connection in waiting:
        connection.close()


def test_large_bodies_leave_room_for_small_ones(
    narrow: httpx2.Client, model: str, capture: SyntheticCapture
) -> None:
    small = orjson.dumps({"model": model, "frames": frames_of(capture.keypoints[:1])})
    large = small + b" " * 96 * KIB
    (waiting,) = hold(narrow, large, lambda: [begin(narrow, sent=100 * KIB, promised=120 * KIB)])
    for _ in range(3):
        assert not refused(narrow, small)
    waiting.close()
    wait_for(lambda: not refused(narrow, large), "the room")


def test_who_leaves_is_lifted_no_further(
    settings: Settings, model: str, capture: SyntheticCapture
) -> None:
    """Refining so many frames takes much longer than this test waits for their place."""
    frames = np.resize(capture.keypoints, (100_000, *capture.keypoints.shape[1:]))
    body = to_safetensors(frames=frames)
    room = {
        "max_frames": 100_000,
        "max_body_bytes": len(body),
        "max_pending_bytes": 4 * len(body) // 3 + 1,
    }
    large = orjson.dumps({"model": model, "frames": frames_of(capture.keypoints[:1])})
    large += b" " * (512 * KIB)
    url = f"/lift?model={model}&refine=full"
    with served(settings.model_copy(update=room)) as http:
        (waiting,) = hold(
            http, large, lambda: [send(http, url, BYTES["Content-Type"], body, len(body))]
        )
        waiting.close()
        wait_for(lambda: not refused(http, large), "the place of the one who left", seconds=15)


class Slow:
    """Requests whose processes are frozen, so that they take as long as the test wants."""

    def __init__(self, spared: set[int]) -> None:
        self._frozen: set[int] = set()
        self._spared = spared
        self._asking: list[Future[httpx2.Response]] = []
        self._threads = ThreadPoolExecutor(8)

    def ask(self, request: Callable[[], httpx2.Response], program: bytes) -> int:
        """Send a request, freeze the process that works on it, and return that."""
        self._asking.append(self._threads.submit(request))

        def begun() -> int | None:
            for pid in descendants(os.getpid()) - self._frozen - self._spared:
                if program in command_of(pid):
                    return pid
            return None

        found: int = wait_for(begun, "a process that works on the request")
        os.kill(found, signal.SIGSTOP)
        self._frozen.add(found)
        return found

    def wait(self) -> bool:
        """Whether all of them still wait for their answers."""
        return not any(asking.done() for asking in self._asking)

    def end(self) -> list[int]:
        """Kill the processes, and return how the requests were answered."""
        for pid in self._frozen:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        answers = [asking.result().status_code for asking in self._asking]
        self._threads.shutdown()
        return answers


def test_slow_readers_keep_nobody_waiting(
    settings: Settings, model: str, capture: SyntheticCapture
) -> None:
    """Two read beside each other leave places; beyond these, nobody waits without end."""
    read, network = b"service.wire.sandbox", b"onnx_file"
    forms = slow_to_read()
    large = to_npz(keypoints=capture.keypoints, ignored=np.zeros(2**18))
    assert len(large) > 2**20

    with served(
        settings.model_copy(update={"large_at_a_time": 1, "max_frames": SLOW_FRAMES})
    ) as http:

        def post() -> httpx2.Response:
            return http.post("/datasets", files=forms)

        def download() -> httpx2.Response:
            return http.get(f"/models/{model}/network")

        def post_large() -> httpx2.Response:
            return http.post("/datasets", content=large, headers=BYTES)

        assert post().status_code == 201
        slow = Slow(spared=descendants(os.getpid()))  # what forks the readers among them
        try:
            first = [slow.ask(post, read) for _ in range(2)]
            assert (post().status_code, post_large().status_code) == (201, 201)
            assert slow.wait()
            wait_for(lambda: os.getpriority(os.PRIO_PROCESS, first[0]) > 0, "others to go first")

            slow.ask(post, read)
            slow.ask(download, network)
            with ThreadPoolExecutor(2) as threads:
                waiting = [threads.submit(ask) for ask in (post, download)]
                assert post_large().status_code == 201
            for answer in (asking.result() for asking in waiting):
                assert "try again" in problem(answer, 503, "overloaded")
                assert int(answer.headers["Retry-After"]) > 0
            assert slow.wait()
        finally:
            answers = slow.end()
        assert answers == [422, 422, 422, 500]
        assert post().status_code == 201  # their places are free again
