"""What a key has opened ends with it, and what is refused costs little and leaves no noise."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Any

import httpx2
import orjson
import pytest
from pydantic import RedisDsn
from redis import Redis
from starlette.testclient import TestClient
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from models.capture.synthetic import SyntheticCapture
from service.app import create_app
from service.settings import Settings
from store import access_keys
from store.access_keys import SCOPES
from store.database import Store
from store.quotas import Quotas
from tests.service.conftest import (
    CONFIG,
    JSON,
    MIB,
    Live,
    frames_of,
    make_dataset,
    problem,
    served,
)
from tests.service.http.test_limits import Chunks
from tests.service.http.test_peers import NOBODY
from tests.service.owner import OwnersClient
from tests.service.test_keys import OF_METHODS, WITHOUT_DOCUMENT, bearer
from tests.waiting import wait_for
from worker.process import tied

# Sends requests as a user, and prints their statuses.
AS_USER = """
import encodings.idna, http.client, json, os, sys
os.setgroups([]), os.setresgid(*[int(sys.argv[1])] * 3), os.setresuid(*[int(sys.argv[1])] * 3)
statuses = []
for method, path in json.loads(sys.argv[3]):
    connection = http.client.HTTPConnection(sys.argv[2].removeprefix("http://"))
    connection.request(method.upper(), path.replace("{", "").replace("}", ""))
    statuses.append(connection.getresponse().status)
    connection.close()
print(json.dumps(statuses))
"""


@pytest.fixture(scope="module")
def closed(settings: Settings) -> Iterator[httpx2.Client]:
    """Serve clients with keys alone."""
    with served(settings.model_copy(update={"trust_local": False})) as http:
        yield http


def ending(stream: ClientConnection, frame: str | None) -> tuple[dict[str, Any], int]:
    """Send a frame, if there is one, until the stream ends; return the last message and code."""
    last = {}
    with suppress(ConnectionClosed):
        while True:
            if frame is not None:
                with suppress(ConnectionClosed):
                    stream.send(frame)
            last = orjson.loads(stream.recv(timeout=60))
    assert stream.close_code is not None
    return last, stream.close_code


@pytest.mark.parametrize("how", ["revoked", "expired"])
def test_what_a_key_has_opened_ends_with_it(
    api: TestClient, closed: httpx2.Client, model: str, capture: SyntheticCapture, how: str
) -> None:
    """Streams, silent or not, followed jobs, and a stream that has not begun."""
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    _, lasting = access_keys.create(store, name="lasts", scopes=["lift"])
    expires_at = time.time() + 3 if how == "expired" else None
    # Created last: where this key is known, the other one is, too.
    record, token = access_keys.create(store, name="ends", scopes=SCOPES, expires_at=expires_at)
    mine, others = bearer(token), bearer(lasting)
    wait_for(lambda: closed.get("/datasets", headers=mine).status_code == 200, "the key")
    body = {"dataset_id": make_dataset(api)["id"], "config": CONFIG}
    job = api.post("/fits", json=body).json()["id"]
    url = f"ws://{closed.base_url.netloc.decode()}/lift/stream"
    frame = orjson.dumps({"sequence": 1, "keypoints": frames_of(capture.keypoints[:1])[0]}).decode()

    def opened(headers: dict[str, str], **start: str) -> ClientConnection:
        stream = stack.enter_context(connect(url, proxy=None, additional_headers=headers))
        if start:
            stream.send(orjson.dumps(start).decode())
            assert orjson.loads(stream.recv(timeout=60))["type"] == "ready"
        return stream

    with ExitStack() as stack:
        silent, without_start = opened(mine, model=model), opened(mine)
        busy, other = opened(mine, model=model), opened(others, model=model)
        events = stack.enter_context(
            closed.stream("GET", f"/fits/{job}/events", headers=mine)
        ).iter_lines()
        assert "progress" in next(events)
        if how == "revoked":
            access_keys.revoke(store, record.id)
        for stream in (silent, without_start, busy):
            last, code = ending(stream, frame if stream is busy else None)
            assert (last["code"], last["sequence"], code) == ("unauthorized", None, 4401)
        assert "event: end" not in [*events]
        again = closed.get(f"/fits/{job}/events", headers=mine)
        problem(again, 401, "unauthorized")
        other.send(frame)
        assert orjson.loads(other.recv(timeout=60))["type"] == "answer"
    api.post(f"/fits/{job}/cancel")


def test_refused_handshakes_leave_no_error_in_the_log(
    closed: httpx2.Client, caplog: pytest.LogCaptureFixture
) -> None:
    url = f"ws://{closed.base_url.netloc.decode()}"
    for path, status in (("/lift/stream", 401), ("/nothing", 401)):
        with pytest.raises(InvalidStatus) as refused:
            connect(url + path, proxy=None)
        assert refused.value.response.status_code == status
    assert not caplog.records


def test_the_connections_that_count_rates_are_closed(settings: Settings) -> None:
    apart = settings.model_copy(update={"redis_url": RedisDsn(f"{settings.redis_url}"[:-1] + "7")})
    with Redis.from_url(str(apart.redis_url)) as redis:

        def connections() -> int:
            return len([c for c in redis.client_list() if c["db"] == "7"])

        before = connections()
        with TestClient(create_app(apart), "http://127.0.0.1") as client:
            store: Store = client.app.state.store  # type: ignore[attr-defined]
            quotas = Quotas(requests_per_second=100)
            _, token = access_keys.create(store, name="c", scopes=["read"], quotas=quotas)
            client.app.state.keyring.look()  # type: ignore[attr-defined]
            assert client.get("/version", headers=bearer(token)).status_code == 200
            assert connections() > before
        assert connections() == before


def test_a_large_body_without_a_key_is_not_read(closed: httpx2.Client) -> None:
    body = Chunks(1024 * MIB)
    answer = closed.post("/datasets", content=iter(body), headers=JSON)
    problem(answer, 401, "unauthorized")
    assert answer.headers["connection"] == "close"
    assert body.taken < 120 * MIB


def test_the_key_of_the_settings_and_no_trust_in_who_is_local(settings: Settings) -> None:
    token = "a" * 40
    closed = settings.model_copy(update={"admin_key": token, "trust_local": False})
    with OwnersClient(create_app(closed)) as client:
        problem(client.get("/datasets"), 401, "unauthorized")
        assert client.get("/keys", headers=bearer(token)).status_code == 200
        assert client.get("/health/ready").status_code == 200  # for balancers
    assert token not in repr(closed)


def test_another_user_of_the_machine_gets_nothing(live: Live) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can be several users")
    paths = live.get("/openapi.json")["paths"]
    asked = [(m, p) for p, item in paths.items() for m in item if m in OF_METHODS]
    asked += WITHOUT_DOCUMENT
    statuses = {}
    for uid in (NOBODY, 0):
        ran = subprocess.run(
            tied(sys.executable, "-c", AS_USER, str(uid), live.url, orjson.dumps(asked).decode()),
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        statuses[uid] = orjson.loads(ran.stdout)
    assert statuses[NOBODY] == [401] * len(asked)
    assert 401 not in statuses[0]
