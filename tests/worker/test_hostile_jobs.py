"""Jobs of any content fail alone: no worker stops, and the job behind them is done."""

import os
import pickle
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import pytest
from redis import Redis
from rq import Queue, Worker
from rq.job import Job, Retry
from rq.serializers import JSONSerializer

from store import jobs, lookup
from store.database import Store
from store.records import FitRecord, LiftRecord
from tests.deployments import scaled_is_thorough
from tests.fork_server import run
from tests.processes import tied
from tests.tiers import thorough_after
from tests.waiting import wait_for
from tests.worker.conftest import CONFIG, StartWorker, queue
from tests.worker.test_plain_data import BOMBS, MOST_MEMORY, circular, deep, shared
from worker.queue import open_queue
from worker.settings import WorkerSettings

BRIEF = CONFIG | {"steps": 1, "refine": "off"}
ARGUMENTS: dict[str, Any] = {
    "a long integer": 10**5000,
    "an integer of 1000 bits": 2**1000,
    "an integer of 65 bits": 2**64,
    "a deep list": deep(300),
    "a list that is just not too deep": deep(90),
    "a circle": circular(),
    "shared lists": shared(8, 10),
    "a long text": "x" * 900_000,
    "half a character": "\ud800",
    "NUL": "a\0b",
    "nothing at all": float("nan"),
    "bytes": b"\xff\0",
    "many numbers": list(range(100_000)),
}
PLACES: dict[str, Callable[[Any], dict[str, Any]]] = {
    "config": lambda value: {"config": BRIEF | {"seed": value}},
    "metadata": lambda value: {"metadata": {"a": value}},
    "dataset_id": lambda value: {"dataset_id": value},
    "name": lambda value: {"name": value},
    "tags": lambda value: {"tags": [value]},
}
Spoil = Callable[[Redis, Job], Any]


def fields(**values: str | bytes) -> Spoil:
    return lambda redis, job: redis.hset(job.key, mapping=cast(Any, values))


@cache
def a_bomb() -> bytes:
    """Return a quarter of a megabyte that declare a quarter of a gigabyte."""
    return zlib.compress(bytes(2**28), 9)


def compressed(redis: Redis, job: Job) -> None:
    redis.hset(job.key, "data", a_bomb())


def compressed_twice(redis: Redis, job: Job) -> None:
    redis.hset(job.key, "data", zlib.compress(a_bomb(), 9))


def claims(*call: Any) -> Spoil:
    return fields(data=zlib.compress(pickle.dumps(call)))


def bombs(every: int) -> dict[str, Spoil]:
    """Return every so many of the bombs, as what a job calls and as what is noted of it."""
    some = {name: BOMBS[name] for name in list(BOMBS)[::every]}
    return {
        **{f"data: {name}": fields(data=data) for name, data in some.items()},
        **{f"meta: {name}": fields(meta=data) for name, data in some.items()},
    }


SPOILT: dict[str, Spoil] = {
    "data that grows": compressed,
    "data that grows twice": compressed_twice,
    "data that is cut": fields(data=zlib.compress(pickle.dumps(("f", None, (), {})))[:-3]),
    "large data": fields(data=bytes(2**25)),
    "large meta": fields(meta=bytes(2**25)),
    "no call": claims("worker.jobs.fit"),
    "a call of a list": claims([], None, (), {}),
    "arguments that are none": claims("worker.jobs.fit", None, 7, 7),
    "names that are none": claims("worker.jobs.fit", None, (), {"dataset_id": 1, "": 2, "x\0": 3}),
    "many arguments": claims("worker.jobs.fit", None, ("x",) * 1000, {}),
    "help with a list": claims("worker.jobs.help_lift", None, ([],), {}),
    "help with a number": claims("worker.jobs.help_lift", None, (2**1000,), {}),
    "help with nothing": claims("worker.jobs.help_lift", None, (), {}),
    "help with half a character": claims("worker.jobs.help_lift", None, ("\ud800\0",), {}),
    "a call on something": claims("worker.jobs.fit", "x", (), {}),
    "dates": fields(created_at="9" * 5000, enqueued_at=b"\xff", started_at="1", ended_at="2020"),
    "numbers": fields(timeout="9" * 5000, result_ttl="9" * 4000, failure_ttl="9" * 4000, ttl="x"),
    "texts": fields(origin=b"\xff", description=b"\xff", worker_name=b"\xff", group_id="none"),
    "another queue": fields(origin="elsewhere"),
    "dependencies": fields(dependency_ids="[" * 5000, allow_dependency_failures="x"),
    "dependencies that are none": fields(dependency_ids='{"a": 1}'),
    "callbacks": fields(success_callback_name=b"\xff", failure_callback_timeout="x"),
    "webhooks": fields(webhooks="[" * 5000),
    "an outcome": fields(result=BOMBS["3000 lists"], exc_info=b"x", status="failed"),
    "retries": fields(retries_left="9" * 4000, retry_intervals="[" * 5000, repeats_left="7"),
    "fields of no name": lambda redis, job: redis.hset(job.key, b"\xff", b"\xff"),
    "no fields": lambda redis, job: redis.delete(job.key),
    "no job": lambda redis, job: (redis.delete(job.key), redis.set(job.key, "x")),
    "executions that are none": lambda redis, job: redis.set(f"rq:executions:{job.id}", "x"),
    "results that are none": lambda redis, job: redis.set(f"rq:results:{job.id}", "x"),
    "dependents that are none": lambda redis, job: redis.set(f"{job.key}:dependents", "x"),
    "a deleted fit": fields(meta=pickle.dumps({"fit_id": [10**100]})),
}


def most_memory(pid: int) -> int:
    """Return the most bytes that a process has had in memory until now."""
    status = Path(f"/proc/{pid}/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def names_of_workers(redis: Redis) -> list[str]:
    return [worker.name for worker in Worker.all(connection=redis)]


@scaled_is_thorough
@pytest.mark.parametrize("place", thorough_after(2, PLACES))
def test_a_hostile_job_fails_alone(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker, place: str
) -> None:
    queue = Queue("fits", connection=redis)
    start_worker()
    wait_for(lambda: len(names_of_workers(redis)) == 1, "the worker")
    started = names_of_workers(redis)
    asked = {}
    for name, value in ARGUMENTS.items():
        arguments = {"dataset_id": dataset_id, "config": BRIEF} | PLACES[place](value)
        asked[f"{place}: {name}"] = queue.enqueue(
            "worker.jobs.fit", kwargs=arguments, description="which RQ would make of them"
        )
    good = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF)
    wait_for(lambda: bool(good.is_finished), "the job behind them to succeed")
    assert names_of_workers(redis) == started  # it did not have to begin anew
    for name, job in asked.items():
        record = jobs.by_job(store, FitRecord, job.id)
        assert record is not None, name
        if job.is_finished:  # what such a field may be, as it happens
            assert record.status == "succeeded", name
        else:
            assert record.status == "failed", name
            assert record.error is not None
            assert record.error["code"] in ("invalid_arguments", "dataset_not_found"), name
            assert len(record.error["message"]) <= 2000
    succeeded = {name for name, job in asked.items() if job.is_finished}
    assert succeeded <= {f"metadata: {name}" for name in ARGUMENTS} | {"name: a long text"}


@pytest.mark.parametrize("every", thorough_after(1, [6, 1]))  # test_plain_data.py reads each bomb
def test_whatever_is_written_about_a_job_stops_no_worker(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker, every: int
) -> None:
    queues = {name: Queue(name, connection=redis) for name in ("fits", "lifts")}
    ask: dict[str, Callable[[], Job]] = {
        "fits": partial(queues["fits"].enqueue, "worker.jobs.fit", "ds_none"),
        "lifts": partial(queues["lifts"].enqueue, "worker.jobs.lift", "mdl_none", "ds_none"),
    }
    spoilt = {}
    for number, (name, spoil) in enumerate((bombs(every) | SPOILT).items()):
        queue = "lifts" if number % 5 == 0 else "fits"
        spoilt[name, queue] = ask[queue]()
        spoil(redis, spoilt[name, queue])
    redis.set("rq:job:my job", "whose name is none, and which is no job either")
    redis.rpush(queues["fits"].key, "my job")
    in_json = Queue("fits", connection=redis, serializer=JSONSerializer)
    good = in_json.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF)
    behind = ask["lifts"]()
    worker = start_worker()
    wait_for(lambda: len(names_of_workers(redis)) == 1, "the worker")
    started, memory = names_of_workers(redis), most_memory(worker.pid)
    wait_for(lambda: bool(good.is_finished and behind.is_failed), "the jobs behind them to end")
    assert names_of_workers(redis) == started
    assert most_memory(worker.pid) - memory < MOST_MEMORY
    wait_for(
        lambda: not any(redis.exists(q.key, q.intermediate_queue_key) for q in queues.values()),
        "all to be gone",
        30,
    )
    for (name, queue), job in spoilt.items():
        if name.startswith("data") and queue == "fits":
            record = jobs.by_job(store, FitRecord, job.id)
            assert record is not None, name
            assert record.status == "failed"
    assert jobs.by_job(store, LiftRecord, behind.id) is not None


def test_a_job_that_is_to_be_tried_for_ever_keeps_nobody_waiting(
    redis: Redis, start_worker: StartWorker
) -> None:
    queue = Queue("fits", connection=redis)
    again = Retry(max=10**9, enqueue_at_front=True)
    first = queue.enqueue("worker.jobs.fit", "ds_none", retry=again)
    behind = queue.enqueue("worker.jobs.fit", "ds_none")
    start_worker()
    wait_for(lambda: bool(behind.is_failed), "the job behind it")
    assert first.is_failed


def test_a_job_that_the_records_refuse_is_set_aside(
    store: Store, redis: Redis, dataset_id: str, start_worker: StartWorker
) -> None:
    """Whatever the reason: here the records have a rule that the job breaks."""
    with store.writing() as session:
        session.connection().exec_driver_sql(
            "CREATE TRIGGER rule BEFORE INSERT ON fits WHEN NEW.name = 'odd' AND "
            "NEW.status != 'failed' BEGIN SELECT RAISE(ABORT, 'odd'); END"
        )
    queue = Queue("fits", connection=redis)
    odd = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF, name="odd")
    good = queue.enqueue("worker.jobs.fit", dataset_id=dataset_id, config=BRIEF)
    start_worker()
    wait_for(lambda: bool(good.is_finished), "the job behind it")
    assert odd.is_failed
    record = jobs.by_job(store, FitRecord, odd.id)
    assert record is not None
    assert record.error is not None
    assert (record.status, record.error["code"]) == ("failed", "internal_error")
    assert open_queue(redis).get_job_ids() == []


# A worker to which SIGTERM comes in the middle of a statement: SQLAlchemy wraps what it raises.
ASKED_TO_LEAVE = """
import os, signal
from rq.exceptions import StopRequested
from sqlalchemy.exc import StatementError
from worker import reconciler, runner
from worker.settings import WorkerSettings

def leave(*_):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except StopRequested as error:
        raise StatementError("", "", {}, error) from error

reconciler.Reconciler.step = leave
runner.run(WorkerSettings())
"""


def test_sigterm_within_a_statement_ends_the_worker(
    store: Store, redis: Redis, dataset_id: str, settings: WorkerSettings
) -> None:
    fit = queue(store, redis, dataset_id, CONFIG)
    environment = os.environ | settings.to_environment()
    ran = run(tied("-c", ASKED_TO_LEAVE), env=environment, timeout=60)
    assert ran.returncode == 0, ran.stderr
    assert lookup.get(store, FitRecord, fit.id).status == "queued"
