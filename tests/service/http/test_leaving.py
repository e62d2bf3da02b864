"""SIGTERM: what is reported, closed, refused and finished before a process of the service ends."""

import socket
import time

import httpx2
import orjson
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from service.settings import Settings
from tests.service.conftest import make_dataset, problem, serving
from tests.service.http.test_overload import begin
from tests.service.realtime.conftest import opened, started
from tests.waiting import wait_for


def test_what_is_in_hand_is_finished_and_nothing_begun(settings: Settings, model: str) -> None:
    with serving(settings.model_copy(update={"grace_seconds": 120})) as (http, leave):
        fit = http.post("/fits", json={"dataset_id": make_dataset(http)["id"]}).json()
        upload = begin(http, sent=2, promised=4)
        waits = httpx2.Client(base_url=http.base_url, timeout=60, trust_env=False)
        with (
            waits,
            waits.stream("GET", f"/fits/{fit['id']}/events") as events,
            started(http, model) as stream,
        ):
            lines = events.iter_lines()
            assert "progress" in next(lines)
            leave()
            with pytest.raises(ConnectionClosed) as closed:
                stream.recv(timeout=60)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1012
            message = list(lines)  # until it ends, as it should
            assert not any("end" in line for line in message if line.startswith("event"))
            ready = http.get("/health/ready")
            problem(ready, 503, "draining")
            assert int(ready.headers["retry-after"]) > 0
            problem(http.get(f"/fits/{fit['id']}/events"), 503, "draining")
            with pytest.raises(InvalidStatus) as refused, opened(http):
                pass
            assert refused.value.response.status_code == 503
            assert orjson.loads(refused.value.response.body)["code"] == "draining"
            assert http.get("/health/live").status_code == 200
            assert http.post(f"/fits/{fit['id']}/cancel").status_code == 202
            with upload:
                upload.sendall(b"{}")
                upload.settimeout(60)
                assert upload.recv(4096).startswith(b"HTTP/1.1 422 ")
        address = (http.base_url.host, http.base_url.port or 0)

        def closed_down() -> bool:
            try:
                socket.create_connection(address).close()
            except ConnectionError:
                return True
            return False

        wait_for(closed_down, "the server to leave", seconds=30)


def test_what_takes_longer_than_the_grace_is_broken_off(settings: Settings) -> None:
    started_at = time.monotonic()
    with (
        serving(settings.model_copy(update={"grace_seconds": 0.2})) as (http, leave),
        begin(http, sent=2, promised=4) as upload,
    ):
        http.get("/health/live")
        leave()
        upload.settimeout(60)
        assert b" 200 " not in upload.recv(4096)
    assert time.monotonic() - started_at < 60


def test_a_balancer_has_time_to_notice(settings: Settings) -> None:
    with serving(settings.model_copy(update={"drain_seconds": 2})) as (http, leave):
        leave()
        wait_for(lambda: http.get("/health/ready").status_code == 503, "draining", seconds=2)
        assert http.get("/datasets").status_code == 200
