"""One key at its worst, and another project's request that is answered meanwhile."""

import os
import select
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from inspect import isasyncgenfunction, iscoroutinefunction

import httpx2
import orjson
import pytest
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from models.capture.synthetic import SyntheticCapture
from service.app import ENDPOINTS, RESOURCES
from service.http.dependencies import in_turn
from service.settings import Settings
from store import access_keys, lookup
from store.access_keys import SCOPES
from store.database import Store
from store.records import DatasetRecord
from tests.processes import command_of, descendants
from tests.service.conftest import (
    BYTES,
    CONFIG,
    JSON,
    MIB,
    frames_of,
    make_dataset,
    problem,
    served,
)
from tests.service.slow_files import SLOW_FRAMES, slow_to_read
from tests.service.test_keys import bearer
from tests.waiting import wait_for

PLACES = 8
OF_ONE_KEY = 6
REQUESTS = 64
Header = dict[str, str]


@pytest.fixture(scope="module")
def greedy(settings: Settings) -> Header:
    return _key(settings, "greedy")


@pytest.fixture(scope="module")
def other(settings: Settings) -> Header:
    return _key(settings, "other")


def _key(settings: Settings, project: str) -> Header:
    store = Store(settings)
    _, token = access_keys.create(store, name=project, project=project, scopes=SCOPES)
    store.close()
    return bearer(token)


@pytest.fixture(scope="module")
def http(settings: Settings, greedy: Header, other: Header) -> Iterator[httpx2.Client]:
    narrow = {
        "max_requests": REQUESTS,
        "max_streams": PLACES,
        "max_event_streams": PLACES,
        "large_at_a_time": 1,
        "max_pending_bytes": 16 * MIB // 3 + 1,
        "request_seconds": 3.0,
        "max_frames": SLOW_FRAMES,
    }
    with served(settings.model_copy(update=narrow)) as client:
        yield client


def stream(http: httpx2.Client, header: Header, path: str = "/lift/stream") -> ClientConnection:
    url = f"ws://{http.base_url.host}:{http.base_url.port}{path}"
    return connect(url, compression=None, proxy=None, additional_headers=header)


def refused(response: httpx2.Response) -> None:
    assert "share" in problem(response, 429, "share_exhausted")
    assert int(response.headers["Retry-After"]) > 0


def test_silent_streams_leave_places_and_do_not_keep_theirs(
    http: httpx2.Client, greedy: Header, other: Header
) -> None:
    with ExitStack() as open_ones:
        silent = [open_ones.enter_context(stream(http, greedy)) for _ in range(OF_ONE_KEY)]
        with pytest.raises(InvalidStatus) as error:
            stream(http, greedy)
        assert error.value.response.status_code == 429
        assert orjson.loads(error.value.response.body)["code"] == "share_exhausted"
        with stream(http, other):
            pass
        last = [orjson.loads(one.recv(timeout=30)) for one in silent]  # after `request_seconds`
    assert {message["code"] for message in last} == {"idle"}


def test_followers_leave_places(http: httpx2.Client, greedy: Header, other: Header) -> None:
    fits = {}
    for name, header in (("greedy", greedy), ("other", other)):
        with httpx2.Client(base_url=http.base_url, headers=header, trust_env=False) as client:
            body = {"dataset_id": make_dataset(client)["id"], "config": CONFIG}
            fits[name] = client.post("/fits", json=body).json()["id"]
    with ExitStack() as following:

        def follow(name: str, header: Header) -> httpx2.Response:
            asked = http.stream("GET", f"/fits/{fits[name]}/events", headers=header)
            return following.enter_context(asked)

        for _ in range(OF_ONE_KEY):
            assert follow("greedy", greedy).status_code == 200
        beyond = follow("greedy", greedy)
        beyond.read()
        refused(beyond)
        assert follow("other", other).status_code == 200


def test_requests_whose_bodies_never_come_leave_places(
    http: httpx2.Client, greedy: Header, other: Header
) -> None:
    lines = "".join(f"{name}: {value}\r\n" for name, value in greedy.items())
    head = f"POST /datasets HTTP/1.1\r\nHost: localhost\r\n{lines}Content-Length: 9\r\n"
    head += f"Content-Type: {BYTES['Content-Type']}\r\n\r\n"
    with ExitStack() as silent:
        address = (http.base_url.host, http.base_url.port or 0)
        connections = [silent.enter_context(socket.create_connection(address)) for _ in range(49)]
        for one in connections:
            one.sendall(head.encode())
        (first, *_), _, _ = select.select(connections, [], [], 60)
        assert b" 429 " in first.recv(MIB)
        refused(http.get("/datasets", headers=greedy))
        assert http.get("/datasets", headers=other).status_code == 200
        assert http.get("/health/live").status_code == 200

    def answered() -> bool:
        return http.get("/datasets", headers=greedy).status_code == 200

    wait_for(answered, "the places of those who left")


def test_requests_that_wait_for_the_records_leave_threads(
    http: httpx2.Client,
    settings: Settings,
    greedy: Header,
    other: Header,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One key changes a record, many times at once, while somebody else writes for long."""
    monkeypatch.setattr("service.http.places.LONGEST_WAIT", 1.0)
    with httpx2.Client(base_url=http.base_url, headers=greedy, trust_env=False) as client:
        dataset = make_dataset(client)["id"]
    others = Store(settings)

    def change() -> httpx2.Response:
        return http.patch(f"/datasets/{dataset}", json={"name": "n"}, headers=greedy)

    with ThreadPoolExecutor(40) as threads:
        with others.writing() as session:
            lookup.lock(session, DatasetRecord, dataset)
            asked = [threads.submit(change) for _ in range(40)]
            most = ENDPOINTS * 3 // 4
            wait_for(lambda: sum(one.done() for one in asked) == 40 - most, "the others' refusal")
            assert http.get("/datasets", headers=other).status_code == 200
            assert http.get("/metrics", headers=other).status_code == 200
            assert sum(one.done() for one in asked) == 40 - most
        answers = [one.result() for one in asked]
    others.close()
    for answer in answers:
        if answer.status_code != 200:
            refused(answer)
    assert sum(answer.status_code == 200 for answer in answers) == most


def test_whatever_works_in_a_thread_has_a_turn_once_its_body_has_come() -> None:
    def flat(dependant: Dependant) -> Iterator[Dependant]:
        for each in dependant.dependencies:
            yield from flat(each)
        yield dependant

    routes = [route for module in RESOURCES for route in module.router.routes]
    seen = 0
    for route in routes:
        if not isinstance(route, APIRoute):
            continue
        calls = [each.call for each in flat(route.dependant)]
        awaited = [iscoroutinefunction(call) or isasyncgenfunction(call) for call in calls]
        if all(awaited):
            continue
        assert in_turn in calls[: awaited.index(False)], route.path
        before = [call for call in calls[:-1] if isasyncgenfunction(call)]
        assert before[-1] is in_turn, route.path
        seen += 1
    assert seen > 40


def held_bodies(http: httpx2.Client, header: Header, sent: int, count: int) -> list[socket.socket]:
    """Send bodies in part, more than are taken, and wait for the refusal of one."""
    lines = "".join(f"{name}: {value}\r\n" for name, value in header.items())
    lines += f"Content-Type: {BYTES['Content-Type']}\r\nContent-Length: {sent + 1}\r\n"
    head = f"POST /datasets HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n".encode()
    held: list[socket.socket] = []
    for _ in range(count):
        held.append(socket.create_connection((http.base_url.host, http.base_url.port or 0)))
        with suppress(OSError):  # it may be refused before all of it has come
            held[-1].sendall(head + b" " * sent)
    (refused, *_), _, _ = select.select(held, [], [], 60)
    assert b" 429 " in refused.recv(MIB)
    return held


def test_bodies_in_hand_leave_space_for_large_and_small_ones(
    http: httpx2.Client, greedy: Header, other: Header
) -> None:
    held = held_bodies(http, greedy, sent=MIB, count=6)
    try:
        body = orjson.dumps({"model": "mdl_none", "frames": []})
        for header in (greedy, other):
            small = http.post("/lift", content=body, headers=header | JSON)
            problem(small, 404, "not_found")
        large = orjson.dumps({"model": "mdl_none", "frames": []}) + b" " * (MIB // 2)
        problem(http.post("/lift", content=large, headers=other | JSON), 404, "not_found")
    finally:
        for one in held:
            one.close()


def test_readers_that_take_long_leave_a_turn(
    http: httpx2.Client,
    greedy: Header,
    other: Header,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    forms = slow_to_read()

    def post(header: Header) -> httpx2.Response:
        return http.post("/datasets", files=forms, headers=header)

    assert post(other).status_code == 201
    before = descendants(os.getpid())  # what forks the readers among them
    frozen: set[int] = set()

    def freeze_one() -> bool:
        reading = [
            p
            for p in descendants(os.getpid()) - frozen - before
            if b"service.wire.sandbox" in command_of(p)
        ]
        for pid in reading:
            os.kill(pid, signal.SIGSTOP)
            frozen.add(pid)
        return len(frozen) == 2

    monkeypatch.setattr("service.http.places.LONGEST_WAIT", 1.0)
    with ThreadPoolExecutor(4) as threads:
        asking = [threads.submit(post, greedy) for _ in range(4)]
        try:
            wait_for(freeze_one, "as many processes as one key may have")
            assert post(other).status_code == 201
            wait_for(lambda: sum(one.done() for one in asking) == 2, "the others to be refused")
        finally:
            for pid in frozen:
                os.kill(pid, signal.SIGKILL)
        answers = sorted((one.result() for one in asking), key=lambda one: one.status_code)
    assert [answer.status_code for answer in answers] == [422, 422, 429, 429]
    for answer in answers[2:]:
        refused(answer)


def test_waiting_fits_leave_places(
    http: httpx2.Client, settings: Settings, greedy: Header, other: Header
) -> None:
    def ask(header: Header) -> Callable[[], httpx2.Response]:
        with httpx2.Client(base_url=http.base_url, headers=header, trust_env=False) as client:
            dataset = make_dataset(client)["id"]
        return lambda: http.post("/fits", json={"dataset_id": dataset}, headers=header)

    mine, others = ask(greedy), ask(other)
    made = []
    while (answer := mine()).status_code == 202:
        made.append(answer.json()["id"])
    refused(answer)
    assert len(made) <= settings.max_queued_fits * 3 // 4
    assert others().status_code == 202


def test_lifts_of_ever_new_views_take_turns_with_others(
    http: httpx2.Client,
    greedy: Header,
    other: Header,
    weights: bytes,
    capture: SyntheticCapture,
) -> None:
    """All of them are asked before the other's: it is answered before most of them."""
    model = {
        name: http.post("/models", content=weights, headers=header | BYTES).json()["id"]
        for name, header in (("greedy", greedy), ("other", other))
    }
    frames = capture.keypoints

    def lift(name: str, header: Header, views: list[int]) -> httpx2.Response:
        body = {"model": model[name], "frames": frames_of(frames[:, views]), "views": views}
        return http.post("/lift?refine=full", content=orjson.dumps(body), headers=header | JSON)

    orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
    lift("other", other, [0, 1, 2])
    with ThreadPoolExecutor(12) as threads:
        asked = [threads.submit(lift, "greedy", greedy, views) for views in orders * 2]
        answer = lift("other", other, [0, 1, 2])
        waiting = sum(not one.done() for one in asked)
        assert answer.status_code == 200
        assert {one.result().status_code for one in asked} == {200}
    assert waiting > len(asked) // 2
