"""Lines of the log of a running service, as text and as JSON: of supervisor, API and workers."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import orjson
import pytest

from tests.fork_server import Popen
from tests.processes import command_of, descendants
from tests.service.conftest import Live, kill_service, make_dataset, start_service
from tests.waiting import wait_for

Line = dict[str, Any]


class Logged:
    """A running service, and what it has written."""

    def __init__(self, folder: Path, *options: str) -> None:
        self._file = folder / "log"

        with self._file.open("w") as log:
            popen: Any = partial(Popen, stderr=log)
            self.live: Live = start_service(folder / "data", *options, popen=popen)

    def lines(self) -> list[str]:
        return self._file.read_text().splitlines()

    def json(self) -> list[Line]:
        """Return every line, each of which is an object."""
        return [orjson.loads(line) for line in self.lines()]


@pytest.fixture(scope="module")
def in_json(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Logged]:
    logged = Logged(tmp_path_factory.mktemp("json"), "--log-format=json", "--lease-seconds=2")
    yield logged
    kill_service(logged.live)


def test_a_fit_carries_its_request_to_the_worker_even_to_the_next(in_json: Logged) -> None:
    """Of API, worker and the worker after that: each line is an object that names the request."""
    live, mine = in_json.live, "from-the-client/1"
    dataset = make_dataset(live.http, frames=8)["id"]
    body = {"dataset_id": dataset, "config": {"dictionary_sizes": [16, 8], "steps": 1_000_000}}
    fit = live.http.post("/fits", json=body, headers={"X-Request-Id": mine}).json()["id"]

    def attempts() -> list[Line]:
        return [line for line in in_json.json() if "attempt" in line["message"]]

    wait_for(lambda: live.get(f"/fits/{fit}")["progress"], "the first step")
    for pid in descendants(live.process.pid):
        if b"service.cli\0worker" in command_of(pid):
            os.kill(pid, signal.SIGKILL)
    wait_for(lambda: len(attempts()) > 1, "another attempt", 60)
    for line in attempts():
        assert line["request_id"] == mine
        assert line["job_id"] == fit
        assert line["logger"] == "worker.jobs"
        assert line["level"] == "INFO"
        assert datetime.fromisoformat(line["time"]).utcoffset() is not None
    live.http.post(f"/fits/{fit}/cancel")
    live.finished(fit)
    loggers = {line["logger"] for line in in_json.json()}
    assert {"service.process.supervisor", "service.resources.datasets"} <= loggers


def test_a_lift_carries_its_request(in_json: Logged, weights: bytes) -> None:
    live = in_json.live
    octets = {"Content-Type": "application/octet-stream"}
    model = live.http.post("/models", content=weights, headers=octets).json()
    frames = [[[[float(k), float(k * k % 7)] for k in range(model["keypoints"])]] * 3] * 6
    dataset = live.http.post("/datasets", json={"keypoints": frames}).json()["id"]
    body = {"dataset_id": dataset, "model_id": model["id"]}
    lift = live.http.post("/lifts", json=body, headers={"X-Request-Id": "a-lift"}).json()["id"]
    assert live.ended(f"/lifts/{lift}")["status"] == "succeeded"

    def of_lift() -> list[Line]:
        return [line for line in in_json.json() if line.get("request_id") == "a-lift"]

    wait_for(lambda: any(line["logger"] == "worker.jobs" for line in of_lift()), "its lines", 10)


def test_faults_are_one_line_with_their_exception(in_json: Logged) -> None:
    live = in_json.live
    objects = live.data_dir / "objects"
    dataset = make_dataset(live.http)["id"]
    for file in sorted((objects / "datasets" / dataset).rglob("*")):
        if file.is_file():
            file.write_bytes(b"x" * file.stat().st_size)
    answer = live.http.get(f"/datasets/{dataset}/capture", headers={"X-Request-Id": "broken"})
    assert answer.status_code == 500

    def of_fault() -> list[Line]:
        return [line for line in in_json.json() if line.get("request_id") == "broken"]

    lines = wait_for(of_fault, "a line", 10)
    assert any(line["level"] in ("WARNING", "ERROR") for line in lines)


def test_the_output_at_the_start_is_an_object_too(in_json: Logged) -> None:
    answer = orjson.loads(in_json.live.printed)
    assert "Ctrl-C stops everything." in answer["message"]


def test_an_error_that_ends_a_process_is_an_object(tmp_path: Path) -> None:
    """And one that ends a thread, and warnings of libraries."""
    program = (
        "import threading, warnings\n"
        "from worker import logs\n"
        "logs.set_up('json')\n"
        "warnings.warn('old')\n"
        "thread = threading.Thread(target=lambda: 1 / 0)\n"
        "thread.start(); thread.join()\n"
        "raise RuntimeError('two\\nlines')\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert ended.returncode == 1
    warning, thread, process = (orjson.loads(line) for line in ended.stderr.splitlines())
    assert warning["level"] == "WARNING"
    assert "old" in warning["message"]
    assert "ZeroDivisionError" in thread["exception"]
    assert process["exception"].endswith("RuntimeError: two\nlines")


def test_text_names_request_and_job(tmp_path: Path) -> None:
    logged = Logged(tmp_path, "--workers=1")
    live = logged.live
    try:
        dataset = make_dataset(live.http, frames=8)["id"]
        body = {"dataset_id": dataset, "config": {"steps": 5}}
        fit = live.http.post("/fits", json=body, headers={"X-Request-Id": "mine"}).json()["id"]
        line = wait_for(
            lambda: next((line for line in logged.lines() if "attempt 1 starts" in line), None),
            "the worker's line",
            60,
        )
        assert line.endswith(f"[request mine, job {fit}]")
        assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} worker\.jobs Fit ", line)
    finally:
        kill_service(live)
