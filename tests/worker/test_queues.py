"""Work waits where a machine for it looks for it; nothing is lost on the way, nobody starves."""

import os
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from redis import Redis
from rq import Queue
from rq.exceptions import DequeueTimeout

from store import datasets, fits, jobs, lifts, lookup, models
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.records import FitRecord, LiftRecord
from tests.fork_server import Popen, run
from tests.processes import tied
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, FitHere, wait_until
from worker.needs import queue_for
from worker.queue import WorkQueue, enqueue, open_queue, open_queues
from worker.reconciler import Reconciler
from worker.settings import WorkerSettings

LARGE = {"dictionary_sizes": [512, 256, 128], "batch_size": 256}

StartTaking = Callable[[str], None]


@pytest.fixture
def start_taking(settings: WorkerSettings) -> Iterator[StartTaking]:
    started: list[subprocess.Popen[bytes]] = []

    def start(takes: str) -> None:
        command = tied("-m", "service.cli", "worker", "--takes", takes)
        environment = os.environ | settings.to_environment()
        del environment["FEWVIEW_TAKES"]
        started.append(Popen(command, env=environment))

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def lift(store: Store, dataset_id: str, fit_here: FitHere) -> LiftRecord:
    columns: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    model = models.create(store, fit_here(CONFIG).to_bytes(), name="m", keypoints=16, **columns)
    return lifts.create(store, model_id=model.id, dataset_id=dataset_id, name="l", chunk_frames=64)


def test_a_worker_takes_from_its_configured_queues(
    store: Store, redis: Redis, dataset_id: str, lift: LiftRecord, start_taking: StartTaking
) -> None:
    fit = fits.create(
        store, dataset_id=dataset_id, name="f", config=CONFIG | {"steps": 1, "refine": "off"}
    )
    for record in (fit, lift):
        enqueue(open_queue(redis, queue_for(store, record)), record)
    start_taking("lifts")
    wait_for(lambda: lookup.get(store, LiftRecord, lift.id).status == "succeeded", "the lift")
    assert lookup.get(store, FitRecord, fit.id).status == "queued"
    start_taking("fits, gpu-fits")
    assert wait_until(store, fit.id, "succeeded", "failed").error is None


def test_fits_that_pay_on_a_gpu_wait_apart_wherever_they_come_from(
    store: Store, redis: Redis, dataset_id: str, settings: WorkerSettings, lift: LiftRecord
) -> None:
    small = fits.create(store, dataset_id=dataset_id, name="f", config={})
    large = fits.create(store, dataset_id=dataset_id, name="g", config=LARGE)
    wanted = {"fits": [small.job_id], "gpu-fits": [large.job_id], "lifts": [lift.job_id]}
    reconciler = Reconciler(store, redis, settings)  # to which all of them are lost

    def queued() -> dict[str, list[str]]:
        reconciler.step()
        return {queue.name: queue.get_job_ids() for queue in open_queues(redis)}

    wait_for(lambda: queued() == wanted, "the work to be queued")
    # What others put elsewhere stays there.
    other = Queue("gpu-fits", connection=redis).enqueue("worker.jobs.fit", dataset_id=dataset_id)
    reconciler.step()
    assert jobs.by_job(store, FitRecord, other.id) is not None
    assert open_queue(redis, "gpu-fits").get_job_ids() == [large.job_id, other.id]


def test_a_job_is_found_again_whichever_queue_it_was_taken_from(redis: Redis) -> None:
    queues = open_queues(redis)
    with pytest.raises(DequeueTimeout):
        WorkQueue.lpop([queue.key for queue in queues], 1, redis)
    for queue in queues:
        job = queue.enqueue("worker.jobs.fit", dataset_id="ds_1")
        taken = WorkQueue.dequeue_any(queues, 1, redis, job_class=queue.job_class)
        assert taken is not None
        assert (taken[0].id, taken[1].name) == (job.id, queue.name)
        assert queue.intermediate_queue.get_job_ids() == [job.id]  # a worker may die now


def test_a_job_that_runs_waits_nowhere(
    redis: Redis, store: Store, lift: LiftRecord, start_taking: StartTaking
) -> None:
    enqueue(open_queue(redis, "lifts"), lift)
    start_taking("lifts,fits")
    wait_for(lambda: lookup.get(store, LiftRecord, lift.id).status == "succeeded", "the lift")
    wait_for(lambda: not open_queue(redis, "lifts").intermediate_queue.get_job_ids(), "no job")


def test_many_lifts_hold_up_no_fit(redis: Redis, start_taking: StartTaking) -> None:
    refused = {"model_id": "mdl_none", "dataset_id": "ds_none"}
    lifts = Queue("lifts", connection=redis)
    asked = [lifts.enqueue("worker.jobs.lift", **refused) for _ in range(4)]
    fit = Queue("fits", connection=redis).enqueue("worker.jobs.fit", dataset_id="ds_none")
    start_taking("lifts,fits,gpu-fits")
    wait_for(lambda: all(job.get_status() == "failed" for job in [*asked, fit]), "all jobs")
    for job in (*asked, fit):
        job.refresh()  # type: ignore[no-untyped-call]
    assert fit.ended_at is not None
    assert asked[1].ended_at is not None
    assert fit.ended_at < asked[1].ended_at


@pytest.mark.parametrize("takes", [",", "fits,fits", "fits,trains"])
def test_queues_that_there_are_not_are_refused(takes: str) -> None:
    ran = run(
        tied("-m", "service.cli", "worker", "--takes", takes),
        env=os.environ | {"FEWVIEW_REDIS_URL": "redis://127.0.0.1:1"},
    )
    assert ran.returncode == 2
    assert "--takes: expected some of lifts, fits, gpu-fits, each once" in ran.stderr


def test_a_large_capture_pays_sooner(store: Store) -> None:
    """What a GPU is given is counted in views and keypoints, too."""
    rng = np.random.default_rng(0)
    config = {"dictionary_sizes": [256, 128], "batch_size": 128}
    found = []
    for views, keypoints in ((2, 10), (12, 200)):
        capture = Capture.checked(rng.normal(size=(3, views, keypoints, 2)))
        dataset = datasets.create(store, capture, CaptureDescription("d"))
        fit = fits.create(store, dataset_id=dataset.id, name="f", config=config)
        found.append(queue_for(store, fit))
    assert found == ["fits", "gpu-fits"]


def test_a_fit_that_is_not_understood_waits_with_the_others(store: Store, dataset_id: str) -> None:
    """Of another version, perhaps: it fails when it is its turn, and holds up nobody before."""
    fit = fits.create(store, dataset_id=dataset_id, name="f", config={})
    assert queue_for(store, lookup.change(store, FitRecord, fit.id, {"config": {"a": 1}})) == "fits"


@pytest.mark.parametrize("deployment", ["scaled"], indirect=True)
def test_what_no_record_can_hold_stops_no_worker(
    store: Store, redis: Redis, dataset_id: str, start_taking: StartTaking
) -> None:
    """Names of jobs, and numbers; wherever they wait, or were taken to."""
    columns: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}
    model = models.create(store, b"w", name="m", keypoints=16, **columns)
    queues = {name: Queue(name, connection=redis) for name in ("fits", "lifts")}
    ask = partial(queues["fits"].enqueue, "worker.jobs.fit", dataset_id="ds_none")
    long = ask(job_id="n" * 201)
    names = (b"\xff", b"my job:1", b"no\0thing")
    redis.rpush(queues["fits"].key, *names)
    redis.rpush(queues["lifts"].intermediate_queue_key, *names)
    lift = partial(queues["lifts"].enqueue, "worker.jobs.lift", model.id, dataset_id)
    unreadable, large = lift(), lift(views=[0, 1, 2**70])
    redis.hset(unreadable.key, "status", "bogus")
    redis.hset(large.key, "meta", b"[1]")
    good = ask()
    start_taking("lifts,fits,gpu-fits")
    wait_for(lambda: all(job.is_failed for job in (long, large, good)), "the jobs to fail")
    wait_for(
        lambda: not any(redis.exists(q.key, q.intermediate_queue_key) for q in queues.values()),
        "all to be gone",
        30,
    )
    shown = ("\ufffd", "my job:1", "no?thing")
    for job_id in (good.id, unreadable.id, "n" * 200, *shown):
        fit = jobs.by_job(store, FitRecord, job_id)
        assert fit is not None
        assert fit.status == "failed"
    for job_id in (large.id, *shown):
        refused = jobs.by_job(store, LiftRecord, job_id)
        assert refused is not None
        assert refused.status == "failed"


def test_what_is_no_job_at_all_stops_no_worker(redis: Redis, start_taking: StartTaking) -> None:
    fits = Queue("fits", connection=redis)
    redis.set("rq:job:odd", "text")
    redis.rpush(fits.key, "odd")
    good = fits.enqueue("worker.jobs.fit", dataset_id="ds_none")
    start_taking("fits")
    wait_for(lambda: good.get_status() == "failed", "the job behind it")
    wait_for(
        lambda: not redis.lrange(fits.intermediate_queue_key, 0, -1), "nothing to be left of it"
    )
