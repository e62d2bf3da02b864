"""A worker whose host's clock is an hour off works beside others, and harms nobody."""

import os
import subprocess
import time
from pathlib import Path

import pytest
from redis import Redis
from rq import Worker

from benchmarks.chaos_clock import Clocks
from store import fits, lookup
from store.database import Store
from store.records import FitRecord
from tests.processes import tied
from tests.tiers import thorough_after
from tests.waiting import wait_for
from tests.worker.conftest import (
    LONG,
    SHORT_LEASE,
    StartWorker,
    wait_for_step,
)
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings

HOUR = 3600.0


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    return settings.model_copy(update={"lease_seconds": SHORT_LEASE})


@pytest.mark.parametrize(
    ("deployment", "off"),
    thorough_after(1, [("embedded", HOUR), ("scaled", -HOUR)]),
    indirect=["deployment"],
)
def test_neither_takes_the_others_fit(
    store: Store,
    redis: Redis,
    dataset_id: str,
    settings: WorkerSettings,
    start_worker: StartWorker,
    tmp_path: Path,
    off: float,
) -> None:
    def queued() -> FitRecord:
        fit = fits.create(store, dataset_id=dataset_id, name="f", config=LONG)
        enqueue(open_queue(redis), fit)
        return fit

    def step_of(fit: FitRecord) -> int:
        progress = lookup.get(store, FitRecord, fit.id).progress
        return 0 if progress is None else int(progress["step"])

    start_worker()
    clocks = Clocks(tmp_path / "clocks")
    with clocks.off(off):
        worker = subprocess.Popen(
            tied("-m", "service.cli", "worker"),
            env=os.environ | settings.to_environment() | clocks.environment,
        )
        wait_for(lambda: Worker.count(connection=redis) == 2, "the other worker")
    try:
        first, second = (one.birth_date for one in Worker.all(connection=redis))
        assert first is not None
        assert second is not None
        assert abs((first - second).total_seconds()) > 0.9 * HOUR
        both = [queued(), queued()]  # one for each: a fit does not end
        for fit in both:
            wait_for_step(store, fit.id, 1)
        begun = {fit.id: step_of(fit) for fit in both}
        time.sleep(SHORT_LEASE)  # in which each has looked after the records a few times
        for fit in both:
            record = lookup.get(store, FitRecord, fit.id)
            assert (record.status, record.attempt, record.crashes) == ("running", 1, 0)
            assert step_of(fit) > begun[fit.id]
    finally:
        worker.kill()
        worker.wait()
