"""The queue's contract, as any RQ producer meets it."""

import threading
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import numpy as np
import pytest
from redis import Redis
from rq import Callback, Queue
from rq.job import Job
from rq.serializers import JSONSerializer
from rq.webhook import Webhook
from safetensors.numpy import load

from models.capture.metrics import pa_mpjpe, pck
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from store import datasets, fits, jobs, lookup, models
from store.capture import Capture
from store.database import Store
from store.labels import labels_of
from store.records import FitRecord, ModelRecord
from tests.deployments import scaled_is_thorough
from tests.waiting import wait_for
from tests.worker.conftest import (
    CONFIG,
    LONG,
    FitHere,
    StartWorker,
    wait_for_step,
    wait_until,
)
from worker.queue import enqueue, open_queue

BRIEF = CONFIG | {"steps": 1, "refine": "off"}


@scaled_is_thorough
@pytest.mark.parametrize("serializer", [None, JSONSerializer])
def test_a_plain_producer_gets_record_progress_and_model(
    store: Store,
    redis: Redis,
    capture: Capture,
    dataset_id: str,
    start_worker: StartWorker,
    fit_here: FitHere,
    serializer: type[JSONSerializer] | None,
) -> None:
    queue = Queue("fits", connection=redis, serializer=serializer)
    labels = {"tags": ["pilot"], "metadata": {"subject": "M7"}}
    job = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=CONFIG, **labels)
    start_worker()
    wait_for(lambda: jobs.by_job(store, FitRecord, job.id) is not None, "the job's record")
    known = jobs.by_job(store, FitRecord, job.id)
    assert known is not None
    record = wait_until(store, known.id, "succeeded", "failed")

    assert record.error is None
    assert record.progress is not None
    assert record.progress["step"] == record.progress["steps"] == CONFIG["steps"]
    assert record.config == FitConfig.model_validate(CONFIG).model_dump(mode="json")
    assert record.model_id is not None
    model = lookup.get(store, ModelRecord, record.model_id)
    assert labels_of(model) == labels_of(record) == labels
    prior = FittedPrior.from_bytes(store.objects.get(model.weights_key))
    assert prior.to_bytes() == fit_here(CONFIG).to_bytes()

    assert record.reconstruction_key is not None
    lift = load(store.objects.get(record.reconstruction_key))
    assert len(lift["points3d"]) == capture.frames
    assert capture.points3d is not None
    accuracy = pa_mpjpe(lift["points3d"], capture.points3d)
    assert model.metrics["pa_mpjpe"] == pytest.approx(accuracy.mean)
    assert model.metrics["pck"] == pytest.approx(pck(accuracy, 0.1))
    assert model.metrics["reprojection_error"] == pytest.approx(
        float(np.nanmean(lift["reprojection_errors"]))
    )
    wait_for(lambda: bool(job.is_finished), "the job to be finished")
    if serializer is None:
        result = job.return_value(refresh=True)
        assert result == {
            "fit_id": record.id,
            "status": "succeeded",
            "model_id": record.model_id,
        }
        assert job.get_meta()["fit_id"] == record.id


def test_a_waiting_job_has_a_record_that_can_be_cancelled(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    queue = Queue("fits", connection=redis)
    first = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=LONG)
    second = queue.enqueue("worker.jobs.fit", dataset_id, LONG, "by position")
    start_worker()
    wait_for(
        lambda: jobs.by_job(store, FitRecord, second.id) is not None, "the waiting job's record"
    )
    waiting = jobs.by_job(store, FitRecord, second.id)
    assert waiting is not None
    assert (waiting.status, waiting.name) == ("queued", "by position")
    assert fits.cancel(store, waiting.id).status == "cancelled"
    running = jobs.by_job(store, FitRecord, first.id)
    assert running is not None
    wait_for_step(store, running.id, 1)
    fits.cancel(store, running.id)
    wait_until(store, running.id, "cancelled", seconds=4)
    wait_for(lambda: bool(second.is_finished), "the cancelled fit's job to end")
    assert lookup.get(store, FitRecord, waiting.id).attempt == 0  # never claimed
    assert lookup.page(store, ModelRecord, limit=1, after=None) == []


def test_a_fit_that_was_deleted_is_not_made_again(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    gone = fits.create(store, dataset_id=dataset_id, name="gone", config=LONG)
    enqueue(open_queue(redis), gone)
    fits.cancel(store, gone.id)
    fits.delete(store, gone.id)
    next_one = Queue("fits", connection=redis).enqueue(
        "worker.jobs.fit", dataset_id=dataset_id, config=CONFIG | {"steps": 2, "refine": "off"}
    )
    start_worker()
    wait_for(lambda: bool(next_one.is_finished), "the other fit")
    assert [fit.name for fit in lookup.page(store, FitRecord, limit=9, after=None)] == ["fit"]


def test_a_job_may_start_from_a_model_and_be_short_of_time(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    queue = Queue("fits", connection=redis)
    first = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=CONFIG)
    start_worker()
    wait_for(lambda: jobs.by_job(store, FitRecord, first.id) is not None, "the job's record")
    known = jobs.by_job(store, FitRecord, first.id)
    assert known is not None
    source = wait_until(store, known.id, "succeeded", "failed").model_id
    assert source is not None

    second = queue.enqueue(
        "worker.jobs.fit",
        dataset_id=dataset_id,
        config={"steps": 1_000_000, "budget_s": 1, "learning_rate": 1e-9, "refine": "off"},
        from_model=source,
    )
    wait_for(lambda: jobs.by_job(store, FitRecord, second.id) is not None, "the job's record")
    warm = jobs.by_job(store, FitRecord, second.id)
    assert warm is not None
    record = wait_until(store, warm.id, "succeeded", "failed")
    assert record.from_model == source
    assert record.config["dictionary_sizes"] == CONFIG["dictionary_sizes"]
    assert record.progress is not None
    assert record.progress["stopped_by"] == "budget"
    assert record.progress["step"] == record.progress["steps"] < 1_000_000
    assert record.model_id is not None
    weights = [
        FittedPrior.from_bytes(
            models.load_weights(store, lookup.get(store, ModelRecord, model_id))
        ).weights
        for model_id in (source, record.model_id)
    ]
    for name, value in weights[0].items():  # with such a learning rate hardly any was changed
        np.testing.assert_allclose(weights[1][name], value, atol=1e-3)


def test_a_fit_whose_model_is_gone_gives_that_reason(
    store: Store, redis: Redis, fit_here: FitHere, dataset_id: str, start_worker: StartWorker
) -> None:
    prior = fit_here(BRIEF)
    source = models.create(
        store,
        prior.to_bytes(),
        name="m",
        fit_id=None,
        dataset_id=None,
        views=3,
        keypoints=16,
        frames=60,
        config=prior.config.model_dump(mode="json"),
        skeleton=None,
        training_curve=[],
        metrics={},
    ).id
    fit = fits.create(store, dataset_id=dataset_id, name="f", config={}, from_model=source)
    with store.writing() as session:  # which the store refuses while the fit waits
        session.delete(lookup.lock(session, ModelRecord, source))
    enqueue(open_queue(redis), fit)
    start_worker()
    error = wait_until(store, fit.id, "succeeded", "failed").error
    assert error is not None
    assert error["code"] == "model_not_found"
    assert source in error["message"]


NEVER_RUN: list[tuple[dict[str, object], str, str]] = [
    ({"from_model": "mdl_gone"}, "model_not_found", "mdl_gone"),
    ({"from_model": 7}, "invalid_arguments", "from_model"),
    ({"config": {"budget_s": 0}}, "invalid_arguments", "budget_s"),
    ({"dataset_id": "ds_gone"}, "dataset_not_found", "ds_gone"),
    ({"dataset_id": 7}, "invalid_arguments", "dataset_id: Input should be a valid string"),
    ({"config": {"steps": 0}}, "invalid_arguments", "steps"),
    (
        {"config": {"stepz": 5}},
        "invalid_arguments",
        "config/stepz: unknown field: did you mean 'steps'?",
    ),
    ({"config": {"calibration": [None]}}, "invalid_arguments", "expected 3, got 1"),
    ({"config": {"handedness": [0, 1, 2, 16]}}, "invalid_arguments", "keypoints below 16"),
    (
        {"config": {"handedness": ["nose", 0, 1, 2]}},
        "invalid_arguments",
        "keypoints of this dataset have no names",
    ),
    ({"tags": ["a "]}, "invalid_arguments", "tags/0: expected printable text"),
    ({"wrong": 1}, "invalid_arguments", "wrong: unknown field: expected some of dataset_id"),
    ({"name": datetime(2026, 1, 1, tzinfo=UTC)}, "invalid_arguments", "datetime"),
]


def has_failed(job: Job) -> bool:
    return bool(job.is_failed)


def test_jobs_that_can_never_run_give_the_reason(
    store: Store,
    redis: Redis,
    dataset_id: str,
    start_worker: StartWorker,
    subtests: pytest.Subtests,
) -> None:
    queue = Queue("fits", connection=redis)
    asked = [
        queue.enqueue("worker.jobs.fit", **{"dataset_id": dataset_id, **arguments})
        for arguments, _, _ in NEVER_RUN
    ]
    start_worker()  # one for all: the next job is taken whatever became of the one before
    for job, (arguments, code, message) in zip(asked, NEVER_RUN, strict=True):
        with subtests.test(arguments=arguments):
            wait_for(partial(has_failed, job), "the job to fail")
            record = jobs.by_job(store, FitRecord, job.id)
            assert record is not None
            assert record.error is not None
            assert record.status == "failed"
            assert record.error["code"] == code
            assert message in record.error["message"]
            assert "pydantic" not in record.error["message"]
            (result,) = job.results()
            assert result.exc_string == f"RuntimeError: {code}: {record.error['message']}"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("status", "bogus"),
        ("created_at", "yesterday"),
        ("timeout", "1 sigh"),
        ("data", b"\x80\xff"),
    ],
)
def test_a_job_that_cannot_be_read_stops_no_worker(
    store: Store,
    redis: Redis,
    dataset_id: str,
    start_worker: StartWorker,
    field: str,
    value: str | bytes,
) -> None:
    queue = Queue("fits", connection=redis)
    unreadable = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id)
    redis.hset(unreadable.key, field, value)
    good = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF)
    worker = start_worker()
    wait_for(lambda: bool(good.is_finished), "the job behind it to succeed")
    assert worker.poll() is None
    record = jobs.by_job(store, FitRecord, unreadable.id)
    assert record is not None
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["code"] == "invalid_arguments"
    assert "cannot be read" in record.error["message"] or field == "data"


def test_no_worker_calls_a_webhook(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    called = threading.Event()

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            called.set()
            self.send_response(204)
            self.end_headers()

    with HTTPServer(("127.0.0.1", 0), Receiver) as receiver:
        threading.Thread(target=receiver.serve_forever, daemon=True).start()
        webhooks = [Webhook(f"http://127.0.0.1:{receiver.server_port}/", "finished", method="POST")]
        queue = Queue("fits", connection=redis)
        job = queue.enqueue(
            "worker.jobs.fit", dataset_id=dataset_id, config=BRIEF, webhooks=webhooks
        )
        start_worker()
        wait_for(lambda: bool(job.is_finished), "the job to succeed")
        assert not called.wait(0.5)
        receiver.shutdown()


class Bomb:
    """Opens a file for writing when it is unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return (open, (self.path, "w"))


def test_nothing_but_plain_data_is_read_and_nothing_but_the_fit_is_run(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker, tmp_path: Path
) -> None:
    queue = Queue("fits", connection=redis)
    bomb = queue.enqueue(
        "worker.jobs.fit", dataset_id=dataset_id, config={"a": Bomb(f"{tmp_path}/gone-off")}
    )
    other = queue.enqueue("os.getcwd", dataset_id=dataset_id, config=CONFIG)
    back = Callback(f"{__name__}.no_such_function")
    good = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF, on_success=back)
    start_worker()
    wait_for(lambda: bool(good.is_finished), "the good job")
    assert bomb.is_failed
    assert not (tmp_path / "gone-off").exists()
    assert other.is_failed
    record = jobs.by_job(store, FitRecord, other.id)
    assert record is not None
    assert (record.status, record.attempt) == ("failed", 0)


def test_a_dataset_that_vanished_under_a_queued_fit(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=CONFIG)
    # The API refuses to delete it now; a restored backup or another program may not.
    with store.writing() as session:
        session.connection().exec_driver_sql("DELETE FROM chunks")
        session.connection().exec_driver_sql("DELETE FROM datasets")
    enqueue(open_queue(redis), fit)
    start_worker()
    record = wait_until(store, fit.id, "failed")
    assert record.error is not None
    assert record.error["code"] == "dataset_not_found"


def test_a_fit_sees_the_frames_there_were_when_it_was_made(
    store: Store, redis: Redis, capture: Capture, dataset_id: str, start_worker: StartWorker
) -> None:
    fit = fits.create(store, dataset_id=dataset_id, name="f", config=BRIEF)
    datasets.append(store, dataset_id, capture, max_frames=1000)
    enqueue(open_queue(redis), fit)
    start_worker()
    record = wait_until(store, fit.id, "succeeded")
    assert record.model_id is not None
    assert lookup.get(store, ModelRecord, record.model_id).frames == capture.frames == fit.frames
