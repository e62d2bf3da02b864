"""Lifts of whole datasets on real workers: shared, interrupted, cancelled, killed."""

import os
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import orjson
import pytest
from redis import Redis
from rq import Queue
from safetensors.numpy import load
from sqlalchemy import delete, select

from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from store import datasets, fits, housekeeping, lift_chunks, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.lift_files import result_file
from store.records import DatasetRecord, FitRecord, LiftChunk, LiftRecord, ModelRecord
from tests.tiers import thorough_after
from tests.waiting import wait_for
from tests.worker.conftest import (
    CONFIG,
    SHORT_LEASE,
    FitHere,
    StartWorker,
    is_alive,
    kill,
    work_horse,
)
from worker.queue import enqueue, open_queue
from worker.settings import WorkerSettings

CHUNK = 64
MOST = 200 * CHUNK
SOME = 60 * CHUNK


@pytest.fixture(scope="module")
def prior(fit_here: FitHere) -> FittedPrior:
    return fit_here(CONFIG)


@pytest.fixture
def settings(settings: WorkerSettings) -> WorkerSettings:
    update = {"lift_chunk_frames": CHUNK, "lift_turn_seconds": 0.5, "lease_seconds": SHORT_LEASE}
    return settings.model_copy(update=update)


@pytest.fixture
def model_id(store: Store, prior: FittedPrior) -> str:
    columns: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    return models.create(store, prior.to_bytes(), name="m", keypoints=16, **columns).id


@pytest.fixture(scope="module")
def frames() -> Capture:
    """As many as several workers have to share for a while."""
    seen = synthetic_capture(frames=400, views=3, noise=1.0, hidden_keypoints=0.05, seed=2)
    repeat = -(-MOST // 400)
    keypoints = np.tile(seen.keypoints, (repeat, 1, 1, 1))[:MOST]
    keypoints += np.arange(MOST, dtype=np.float32)[:, None, None, None] / 1000
    confidence = np.tile(seen.confidence, (repeat, 1, 1))[:MOST]
    return Capture.checked(keypoints, confidence)


MakeLift = Callable[..., LiftRecord]


@pytest.fixture
def make_lift(
    store: Store, redis: Redis, model_id: str, frames: Capture, settings: WorkerSettings
) -> MakeLift:
    def make(count: int = SOME, **more: Any) -> LiftRecord:
        confidence = frames.confidence
        assert confidence is not None
        half = count // 2 + 5  # the cut between two uploads lies within a chunk
        first = Capture(frames.keypoints[:half], confidence[:half])
        rest = Capture(frames.keypoints[half:count], confidence[half:count])
        dataset = datasets.create(store, first, CaptureDescription("many"))
        datasets.append(store, dataset.id, rest, max_frames=count)
        lift = lifts.create(
            store,
            model_id=model_id,
            dataset_id=dataset.id,
            name="l",
            chunk_frames=settings.lift_chunk_frames,
            **more,
        )
        enqueue(open_queue(redis), lift)
        return lift

    return make


def wait_until(store: Store, lift: LiftRecord, *statuses: str, seconds: float = 120) -> LiftRecord:
    get = lookup.get
    wait_for(lambda: get(store, LiftRecord, lift.id).status in statuses, f"{statuses}", seconds)
    return get(store, LiftRecord, lift.id)


def wait_for_chunks(store: Store, lift: LiftRecord, count: int) -> None:
    def reached() -> bool:
        record = lookup.get(store, LiftRecord, lift.id)
        assert record.status in ("queued", "running"), (record.status, record.error)
        return record.chunks_done >= count

    wait_for(reached, f"{count} chunks")


def succeeded(store: Store, lift: LiftRecord) -> list[LiftChunk]:
    record = wait_until(store, lift, "succeeded", "failed")
    assert record.error is None
    assert record.frames_done == record.frames
    return lifts.finished_chunks(store, record)


def holders(store: Store) -> set[str]:
    with store.reading() as session:
        found = session.scalars(select(LiftChunk.holder).where(LiftChunk.holder.is_not(None)))
        return set(map(str, found))


def is_writable(settings: WorkerSettings) -> bool:
    """Return whether nobody is amid a transaction, frozen or not."""
    with closing(sqlite3.connect(settings.data_dir / "records.db", timeout=0.1)) as records:
        try:
            records.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError:
            return False
    return True


def assert_is_lift_of(store: Store, lift: LiftRecord, frames: Capture, prior: FittedPrior) -> None:
    """Compare a result with the lift of the same frames by the prior, here and in one call."""
    record = lookup.get(store, LiftRecord, lift.id)
    file = result_file(record, lifts.finished_chunks(store, record), "safetensors", {})
    found = load(b"".join(file.read(store.objects.get_range, 0, file.size)))
    assert frames.confidence is not None
    here = prior.lift(
        frames.keypoints[: lift.frames],
        confidence=frames.confidence[: lift.frames],
        refine=lift.refine,  # type: ignore[arg-type]
    )
    assert len(found["points3d"]) == lift.frames
    for name, array in found.items():
        np.testing.assert_allclose(array, getattr(here, name), rtol=1e-3, atol=1e-3, err_msg=name)


def test_a_lift_is_the_same_as_at_once_in_every_format(
    store: Store,
    make_lift: MakeLift,
    frames: Capture,
    prior: FittedPrior,
    start_worker: StartWorker,
) -> None:
    plain, refined = make_lift(5 * CHUNK - 7, refine="off"), make_lift(CHUNK + 1, refine="full")
    start_worker()
    for lift in (plain, refined):
        chunks = succeeded(store, lift)
        assert [chunk.crashes for chunk in chunks] == [0] * lift.chunks
        assert_is_lift_of(store, lift, frames, prior)
    file = result_file(plain, lifts.finished_chunks(store, plain), "jsonl", {})
    lines = b"".join(file.read(store.objects.get_range, 0, file.size)).splitlines()
    assert len(lines) == plain.frames
    assert frames.confidence is not None
    one = slice(70, 71)
    here = prior.lift(frames.keypoints[one], confidence=frames.confidence[one], refine="off")
    line = orjson.loads(lines[70])
    np.testing.assert_allclose(line["points3d"], here.points3d[0], rtol=1e-3, atol=1e-3)
    assert [view["camera"] for view in line["views"]] == ["weak_perspective"] * 3


def test_workers_share_the_chunks(
    store: Store, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    lift = make_lift(MOST, refine="off")
    workers = [start_worker(), start_worker()]
    wait_for_chunks(store, lift, 1)
    seen: set[str] = set()

    def both_hold_chunks() -> bool:
        seen.update(holders(store))
        assert lookup.get(store, LiftRecord, lift.id).status == "running", "one worker did it all"
        return len(seen) >= 2

    wait_for(both_hold_chunks, "both workers to help")
    succeeded(store, lift)
    assert len(seen) == 2
    assert all(worker.poll() is None for worker in workers)


@pytest.mark.parametrize("whom", thorough_after(1, ["worker", "horse"]))
def test_who_is_killed_loses_one_chunk_and_nothing_is_done_twice(
    store: Store,
    make_lift: MakeLift,
    frames: Capture,
    prior: FittedPrior,
    start_worker: StartWorker,
    whom: str,
) -> None:
    lift = make_lift(refine="off")
    worker = start_worker()
    wait_for_chunks(store, lift, 3)
    horse = work_horse(worker)
    if whom == "horse":
        kill(horse)
    else:
        worker.kill()
        worker.wait()
    wait_for(lambda: not is_alive(horse), "the work-horse to be gone", 2)
    before = {c.first_frame: c.arrays_key for c in lifts.finished_chunks(store, lift)}
    assert len(before) < lift.chunks
    if whom == "worker":
        start_worker()
    chunks = succeeded(store, lift)
    after = {chunk.first_frame: chunk.arrays_key for chunk in chunks}
    assert before.items() <= after.items()
    assert sum(chunk.crashes for chunk in chunks) <= 1
    assert_is_lift_of(store, lift, frames, prior)
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)
    left = [key for key, _ in store.objects.list() if key.startswith("lifts/")]
    assert len(left) == 2 * lift.chunks


def test_a_worker_that_gets_sigterm_gives_its_chunk_back(
    store: Store, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    lift = make_lift(refine="off")
    worker = start_worker()
    wait_for_chunks(store, lift, 3)
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(10) == 0
    record = lookup.get(store, LiftRecord, lift.id)
    assert record.status == "running"
    assert not holders(store)
    start_worker()
    assert all(chunk.crashes == 0 for chunk in succeeded(store, lift))


def test_the_queue_forgets_everything(
    store: Store, redis: Redis, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    queued = make_lift(3 * CHUNK, refine="off")
    redis.flushall()
    start_worker()
    succeeded(store, queued)


def test_cancelling_frees_the_worker_and_leaves_nothing(
    store: Store, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    lift = make_lift()
    worker = start_worker()
    wait_for_chunks(store, lift, 2)
    horse = work_horse(worker)
    assert lifts.cancel(store, lift.id).status == "cancelled"
    wait_for(lambda: not is_alive(horse), "the work-horse to end", 4)
    housekeeping.sweep(store, orphan_seconds=-1, grace_seconds=-1)  # what it was writing just then
    assert not [key for key, _ in store.objects.list() if key.startswith("lifts/")]
    succeeded(store, make_lift(CHUNK, refine="off"))


def test_a_frozen_helper_loses_its_chunk(
    store: Store, settings: WorkerSettings, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    lift = make_lift(20 * CHUNK, refine="full")
    frozen = start_worker()
    wait_for_chunks(store, lift, 2)
    horse = work_horse(frozen)

    def caught_with_a_chunk() -> bool:
        for pid in (frozen.pid, horse):
            os.kill(pid, signal.SIGSTOP)
        if is_writable(settings) and holders(store):
            return True
        for pid in (horse, frozen.pid):
            os.kill(pid, signal.SIGCONT)
        return False

    wait_for(caught_with_a_chunk, "the helper to lift a chunk")
    time.sleep(SHORT_LEASE + 0.5)
    start_worker()

    def taken() -> bool:
        with store.reading() as session:
            return session.query(LiftChunk).where(LiftChunk.crashes > 0).count() > 0

    wait_for(taken, "another to take the chunk")
    for pid in (horse, frozen.pid):
        os.kill(pid, signal.SIGCONT)
    succeeded(store, lift)


def test_a_fit_behind_a_long_lift_gets_its_turn(
    store: Store,
    redis: Redis,
    make_lift: MakeLift,
    dataset_id: str,
    start_worker: StartWorker,
) -> None:
    lift = make_lift(refine="full")
    start_worker()
    wait_for_chunks(store, lift, 1)
    fit = fits.create(
        store, dataset_id=dataset_id, name="f", config=CONFIG | {"steps": 5, "refine": "off"}
    )
    enqueue(open_queue(redis), fit)
    wait_for(lambda: lookup.get(store, FitRecord, fit.id).status == "succeeded", "the fit")
    assert lookup.get(store, LiftRecord, lift.id).status == "running"
    lifts.cancel(store, lift.id)


def test_a_plain_producer_gets_a_lift(
    store: Store, redis: Redis, model_id: str, dataset_id: str, start_worker: StartWorker
) -> None:
    queue = Queue("fits", connection=redis)
    job = queue.enqueue("worker.jobs.lift", model_id, dataset_id, "by position", views=[2, 0, 1])
    start_worker()
    wait_for(lambda: lifts.helped(store, job.id) is not None, "the job's record")
    lift = lifts.helped(store, job.id)
    assert lift is not None
    assert (lift.name, lift.views, lift.refine) == ("by position", [2, 0, 1], None)
    succeeded(store, lift)
    wait_for(lambda: bool(job.is_finished), "the job to be finished")
    assert job.return_value(refresh=True) == {"lift_id": lift.id, "status": "succeeded"}
    assert job.get_meta()["lift_id"] == lift.id


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ({"dataset_id": "ds_gone"}, "dataset_not_found", "ds_gone"),
        ({"model_id": "mdl_gone"}, "model_not_found", "mdl_gone"),
        ({"model_id": None}, "invalid_arguments", "model_id"),
        ({"refine": "some"}, "invalid_arguments", "refine"),
        ({"uncertainty": "some"}, "invalid_arguments", "uncertainty"),
        ({"views": [0, 1]}, "invalid_arguments", "one index per view of the dataset"),
        ({"views": [0, 1, 7]}, "invalid_arguments", "views must name 3 different views"),
        ({"frame": "room"}, "invalid_arguments", "has no room"),
        ({"up": "auto"}, "invalid_arguments", "up needs frame=room"),
        ({"config": {}}, "invalid_arguments", "config: unknown field: expected some of model_id"),
    ],
)
def test_a_job_that_can_never_run_gives_the_reason(
    store: Store,
    redis: Redis,
    model_id: str,
    dataset_id: str,
    start_worker: StartWorker,
    arguments: dict[str, Any],
    code: str,
    message: str,
) -> None:
    asked = {"model_id": model_id, "dataset_id": dataset_id} | arguments
    job = Queue("fits", connection=redis).enqueue("worker.jobs.lift", kwargs=asked)
    start_worker()
    wait_for(lambda: bool(job.is_failed), "the job to fail")
    record = lifts.helped(store, job.id)
    assert record is not None
    assert record.error is not None
    assert (record.status, record.error["code"]) == ("failed", code)
    assert message in record.error["message"]


@pytest.mark.parametrize("what", ["dataset", "model"])
def test_what_vanishes_under_a_lift_fails_it(
    store: Store, make_lift: MakeLift, start_worker: StartWorker, what: str
) -> None:
    records = {"dataset": DatasetRecord, "model": ModelRecord}
    lift = make_lift(3 * CHUNK, refine="off")
    # The API refuses to delete it now; a restored backup or another program may not.
    with store.writing() as session:
        session.execute(delete(records[what]))
    start_worker()
    record = wait_until(store, lift, "failed")
    assert record.error is not None
    assert record.error["code"] == f"{what}_not_found"


def test_a_call_for_help_with_a_lift_that_is_gone_makes_nothing(
    store: Store, redis: Redis, make_lift: MakeLift, start_worker: StartWorker
) -> None:
    lift = make_lift(CHUNK)
    lifts.cancel(store, lift.id)
    lifts.delete(store, lift.id)
    job = open_queue(redis).fetch_job(lift.id)
    assert job is not None
    start_worker()
    wait_for(lambda: bool(job.is_finished), "the job to end")
    with store.reading() as session:
        assert session.query(LiftRecord).count() == 0
        assert lift_chunks.claim(store, lift_chunks.join(lift.id, lease_seconds=1)) is None
