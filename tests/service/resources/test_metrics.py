"""What `GET /metrics` shows is what happened, whichever process it happened in."""

import os
import re
import signal
import socket
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx2
import orjson
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from models.capture.synthetic import SyntheticCapture
from service.app import create_app
from service.settings import Settings
from tests.deployments import on_every_deployment
from tests.processes import command_of, descendants
from tests.service.conftest import (
    BYTES,
    JSON,
    Live,
    frames_of,
    kill_service,
    make_dataset,
    served,
    start_service,
)
from tests.service.owner import OwnersClient
from tests.service.process.test_api_processes import api_processes, by_process, stream_of_each
from tests.waiting import wait_for

Series = dict[tuple[str, frozenset[tuple[str, str]]], float]


def metrics(http: Any) -> Series:
    """Return every series, parsed by Prometheus's own parser."""
    answer = http.get("/metrics")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith("text/plain; version=")
    found: Series = {}
    for family in text_string_to_metric_families(answer.text):
        for sample in family.samples:
            key = (sample.name, frozenset(sample.labels.items()))
            assert key not in found, f"twice: {key}"
            found[key] = sample.value
    return found


def value(found: Series, name: str, **labels: str) -> float:
    return found.get((name, frozenset(labels.items())), 0.0)


def grown(before: Series, after: Series, name: str, **labels: str) -> float:
    return value(after, name, **labels) - value(before, name, **labels)


def test_requests_are_counted_by_route(api: TestClient, model: str) -> None:
    before = metrics(api)
    for number in range(3):
        api.get(f"/fits/fit_{number}")
        api.get(f"/no/such/path/{number}")
    api.head("/version")
    api.delete("/version")
    api.post("/lift", content=orjson.dumps({"model": model, "frames": "x"}), headers=JSON)
    api.request("BREW", "/version")
    after = metrics(api)
    total = "fewview_http_requests_total"
    for count, method, route, status in (
        (3, "GET", "/fits/{fit_id}", "404"),
        (3, "GET", "other", "404"),
        (1, "HEAD", "/version", "200"),
        (1, "DELETE", "/version", "405"),
        (1, "POST", "/lift", "422"),
        (1, "other", "/version", "405"),
        (1, "GET", "/metrics", "200"),
    ):
        of = {"method": method, "route": route}
        assert grown(before, after, total, **of, status=status) == count, (method, route)
        assert grown(before, after, "fewview_http_request_duration_seconds_count", **of) >= count
    assert grown(before, after, "fewview_http_problems_total", status="404", code="not_found") == 6
    assert not any("fit_0" in text for _, labels in after for _, text in labels)


def test_refusals_are_counted_by_their_code(settings: Settings) -> None:
    few = settings.model_copy(update={"max_queued_fits": 1, "max_streams": 1})
    with OwnersClient(create_app(few)) as api:
        dataset = make_dataset(api)["id"]
        before = metrics(api)
        made = [api.post("/fits", json={"dataset_id": dataset}) for _ in range(22)]
        refused = [answer for answer in made if answer.status_code == 429]
        assert refused
        after = metrics(api)
        for answer in made:
            if answer.status_code == 202:
                api.post(f"/fits/{answer.json()['id']}/cancel")
    of = {"status": "429", "code": "too_many_fits"}
    assert grown(before, after, "fewview_http_problems_total", **of) == len(refused)


def test_what_is_no_request_is_counted_too(settings: Settings) -> None:
    with served(settings) as http:
        before = metrics(http)
        where = (http.base_url.host, http.base_url.port or 0)
        with socket.create_connection(where, 20) as connection:
            connection.sendall(b"nonsense\r\n\r\n")
            assert connection.recv(1000).startswith(b"HTTP/1.1 400 ")
        after = metrics(http)
    of = {"status": "400", "code": "malformed_request"}
    assert grown(before, after, "fewview_http_problems_total", **of) == 1


@on_every_deployment
def test_jobs_and_bytes_are_those_of_the_records(api: TestClient) -> None:
    before = metrics(api)
    dataset = make_dataset(api, frames=10)
    fit = api.post("/fits", json={"dataset_id": dataset["id"]}).json()
    after = metrics(api)
    assert grown(before, after, "fewview_jobs", kind="fit", status="queued") == 1
    assert value(after, "fewview_oldest_waiting_job_seconds", kind="fit") > 0
    objects = api.app.state.store.objects  # type: ignore[attr-defined]
    stored = sum(len(objects.get(key)) for key, _ in objects.list() if dataset["id"] in key)
    kept = api.get("/storage?limit=200").json()["largest"]
    (with_record,) = (item["stored_bytes"] for item in kept if item["id"] == dataset["id"])
    assert grown(before, after, "fewview_stored_bytes", of="datasets") == with_record > stored
    api.post(f"/fits/{fit['id']}/cancel")
    ended = metrics(api)
    assert grown(after, ended, "fewview_jobs", kind="fit", status="queued") == -1
    assert grown(after, ended, "fewview_jobs", kind="fit", status="cancelled") == 1
    assert {value(ended, "fewview_part_reached", part=part) for part in ("records", "queue")} == {1}


def test_names_follow_the_conventions(api: TestClient, model: str) -> None:
    text = api.get("/metrics").text
    kinds = dict(re.findall(r"^# TYPE (\S+) (\S+)$", text, re.MULTILINE))
    for name, kind in kinds.items():
        assert re.fullmatch(r"fewview_[a-z_]+", name)
        if not name.endswith("_created"):
            assert name.endswith("_total") == (kind == "counter"), name
    described = api.get("/openapi.json").json()["paths"]["/metrics"]["get"]["responses"]["200"]
    assert list(described["content"]) == ["text/plain"]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    live = start_service(
        tmp_path_factory.mktemp("two"), "--api-processes=2", "--lease-seconds=2", "--max-streams=2"
    )
    yield live
    kill_service(live)


def test_all_processes_are_one_service(
    two: Live, weights: bytes, capture: SyntheticCapture
) -> None:
    """Either shows what both did; one that dies and its successor are one, and sockets close."""
    lifts = {"method": "POST", "route": "/lift", "status": "200"}
    total, open_now = "fewview_http_requests_total", "fewview_websockets_open"
    with ExitStack() as stack:
        first, second = by_process(two, stack)
        model = first.http.post("/models", content=weights, headers=BYTES).json()["id"]
        body = {"model": model, "frames": frames_of(capture.keypoints[:2])}
        before = metrics(first.http)
        for live in (first, first, second):
            assert live.http.post("/lift", json=body).status_code == 200
        with ExitStack() as streams:
            stream_of_each(two, model, streams)
            for live in (first, second):

                def counted(live: Live = live) -> bool:
                    after = metrics(live.http)
                    return (
                        grown(before, after, total, **lifts),
                        grown(before, after, "fewview_lift_duration_seconds_count"),
                        grown(before, after, "fewview_lift_batch_frames_sum"),
                        value(after, open_now),
                    ) == (3, 3, 6, 2)

                wait_for(counted, "what both did", 10)
            victim = api_processes(two)[0]
            os.kill(victim, signal.SIGKILL)
            wait_for(
                lambda: len(found := api_processes(two)) == 2 and victim not in found, "another"
            )
            wait_for(lambda: value(metrics(two.http), open_now) == 1, "the other to have started")
            assert grown(before, metrics(two.http), total, **lifts) == 3
        wait_for(lambda: value(metrics(two.http), open_now) == 0, "the sockets to be closed")


def test_lost_leases_and_retries_of_workers_are_counted(
    two: Live, capture: SyntheticCapture
) -> None:
    """By whoever notices them, in whatever process, though each job has one of its own."""
    dataset = make_dataset(two.http, frames=8)["id"]
    fit = two.fit(dataset, steps=1_000_000)["id"]
    before = metrics(two.http)
    wait_for(lambda: two.get(f"/fits/{fit}")["progress"], "the first step")
    for pid in _workers(two):
        os.kill(pid, signal.SIGKILL)

    def counted() -> bool:
        found = metrics(two.http)
        names = ("fewview_job_lease_losses_total", "fewview_job_retries_total")
        return all(grown(before, found, name, kind="fit") == 1 for name in names)

    wait_for(counted, "the loss and the new attempt", 60)
    assert value(metrics(two.http), "fewview_jobs", kind="fit", status="running") == 1
    two.http.post(f"/fits/{fit}/cancel")
    two.finished(fit)


def _workers(live: Live) -> list[int]:
    """Return the worker and the process of its job."""
    family = descendants(live.process.pid)
    return [pid for pid in family if b"service.cli\0worker" in command_of(pid)]


def test_what_is_away_is_left_out(settings: Settings, tmp_path: Path) -> None:
    """The others are shown, and the answer names what is missing."""
    here = settings.model_copy(update={"data_dir": tmp_path, "database_url": None})
    with OwnersClient(create_app(here), raise_server_exceptions=False) as api:
        assert value(metrics(api), "fewview_part_reached", part="records") == 1
        with api.app.state.store.engine.begin() as connection:  # type: ignore[attr-defined]
            connection.exec_driver_sql("ALTER TABLE lifts RENAME TO gone")
        found = metrics(api)
        assert value(found, "fewview_part_reached", part="records") == 0
        assert value(found, "fewview_part_reached", part="queue") == 1
        assert not any(name == "fewview_jobs" for name, _ in found)
        of = {"method": "GET", "route": "/metrics", "status": "200"}
        assert value(found, "fewview_http_requests_total", **of) >= 1


def test_no_folder_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not at the end, and not for long after a supervisor was killed."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)

    def folders() -> list[Path]:
        return sorted(tmp_path.glob("fewview-metrics-*"))

    killed = start_service(tmp_path / "data", "--workers=0")
    left = folders()
    assert len(left) == 1
    kill_service(killed)
    live = start_service(tmp_path / "data", "--workers=0")
    assert len(folders()) == 1
    assert folders() != left
    assert httpx2.get(f"{live.url}/metrics", trust_env=False).status_code == 200
    live.process.send_signal(signal.SIGTERM)
    assert live.process.wait(30) == 0
    kill_service(live)
    assert folders() == []
