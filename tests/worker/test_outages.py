"""Records and objects that go away for a while end no fit and no lift."""

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from redis import Redis
from rq import Queue, Worker

from store import datasets, fits, jobs, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.jobs import TERMINAL
from store.records import FitRecord, LiftRecord
from tests.object_stores import folder_away
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, FitHere, StartWorker, wait_for_step, wait_until
from worker import patience
from worker.queue import enqueue, open_queue

CHUNKS = 100
BRIEF = CONFIG | {"steps": 1, "refine": "off"}
SLOW = CONFIG | {"steps": 400, "refine": "off"}


@contextmanager
def objects_away(store: Store) -> Iterator[None]:
    """Have nothing but errors from the objects."""
    with folder_away(Path(store.objects.url.removeprefix("file://"))):
        yield


@contextmanager
def records_away(store: Store) -> Iterator[None]:
    """Hold the records' lock, longer than anyone waits for it."""
    assert store.engine.url.database is not None
    with closing(sqlite3.connect(store.engine.url.database, isolation_level=None)) as holder:
        holder.execute("BEGIN IMMEDIATE")
        yield
        holder.execute("ROLLBACK")


@pytest.fixture
def lift(store: Store, capture: Capture, fit_here: FitHere) -> LiftRecord:
    """Record a lift of many chunks."""
    about: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    weights = fit_here(CONFIG).to_bytes()
    model = models.create(store, weights, name="m", keypoints=16, **about)
    many = Capture(np.tile(capture.keypoints, (CHUNKS, 1, 1, 1)))
    dataset = datasets.create(store, many, CaptureDescription("many"))
    return lifts.create(
        store,
        model_id=model.id,
        dataset_id=dataset.id,
        name="l",
        chunk_frames=capture.frames,
    )


@pytest.mark.parametrize(("away", "seconds"), [(objects_away, 3.0), (records_away, 22.0)])
def test_a_fit_and_a_lift_outlive_an_outage(
    store: Store,
    redis: Redis,
    dataset_id: str,
    lift: LiftRecord,
    start_worker: StartWorker,
    away: Callable[[Store], AbstractContextManager[None]],
    seconds: float,
) -> None:
    def lifted() -> LiftRecord:
        return lookup.get(store, LiftRecord, lift.id)

    fit = fits.create(store, dataset_id=dataset_id, name="f", config=SLOW)
    for record in (fit, lift):  # a worker for each
        enqueue(open_queue(redis), record)
        start_worker()
    wait_for_step(store, fit.id, 20)
    wait_for(lambda: lifted().chunks_done > 0, "a chunk")
    assert lifted().status == "running"
    with away(store):
        time.sleep(seconds)
    ended = wait_until(store, fit.id, "succeeded", "failed")
    assert ended.error is None
    assert ended.crashes == 0
    assert ended.model_id is not None
    assert lookup.get(store, FitRecord, fit.id).reconstruction_key is not None
    wait_for(lambda: lifted().status in TERMINAL, "the lift's end")
    assert (lifted().status, lifted().error) == ("succeeded", None)
    assert {chunk.crashes for chunk in lifts.finished_chunks(store, lifted())} == {0}


def test_a_job_that_comes_while_objects_are_away_waits_for_them(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    start_worker()
    wait_for(lambda: Worker.count(connection=redis) == 1, "the worker")
    with objects_away(store):
        queue = Queue("fits", connection=redis)
        job = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF)
        wait_for(lambda: jobs.by_job(store, FitRecord, job.id) is not None, "its record", 20)
        time.sleep(3)
    fit = jobs.by_job(store, FitRecord, job.id)
    assert fit is not None
    assert wait_until(store, fit.id, "succeeded", "failed").error is None
    wait_for(lambda: job.get_status(refresh=True) == "finished", "the job's end", 10)


def test_what_is_no_outage_is_not_waited_out() -> None:
    def missing() -> None:
        raise FileNotFoundError

    def wrong() -> None:
        raise ValueError

    for work, kind in ((missing, FileNotFoundError), (wrong, ValueError)):
        with pytest.raises(kind):
            patience.patiently(work, hurry=lambda: False)


def test_an_outage_that_does_not_end_is_given_up() -> None:
    tries = 0

    def away() -> None:
        nonlocal tries
        tries += 1
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        patience.patiently(away, hurry=lambda: False, seconds=0.3)
    assert tries > 2
    with pytest.raises(OSError, match="no space"):
        patience.patiently(away, hurry=lambda: True)
