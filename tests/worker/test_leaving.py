"""A worker that gets SIGTERM leaves, whatever it is about to do."""

import os
import signal

from redis import Redis
from rq import Queue

from store import lookup
from store.database import Store
from store.records import FitRecord
from tests.fork_server import Popen, run
from tests.processes import tied
from tests.worker.conftest import LONG, queue
from worker.settings import WorkerSettings

# A worker that gets SIGTERM when it has a job, but no process for it yet.
TOLD_BEFORE_THE_JOB = """
import os, signal
from worker import runner
from worker.settings import WorkerSettings

class Told(runner.JobWorker):
    def fork_work_horse(self, job, queue):
        os.kill(os.getpid(), signal.SIGTERM)
        super().fork_work_horse(job, queue)

runner.JobWorker = Told
runner.run(WorkerSettings())
"""
# The same in an import that takes whatever is raised for its own.
TOLD_IN_AN_IMPORT = """
import os, signal
from contextlib import suppress
from worker import runner
from worker.settings import WorkerSettings

def import_for_later_jobs():
    runner._import_for_later_jobs = lambda: None  # once
    with suppress(Exception):
        os.kill(os.getpid(), signal.SIGTERM)

runner._import_for_later_jobs = import_for_later_jobs
runner.run(WorkerSettings())
"""


def test_the_worker_gets_sigterm_in_an_import(redis: Redis, settings: WorkerSettings) -> None:
    Queue("fits", connection=redis).enqueue("worker.jobs.fit", dataset_id="ds_none")
    environment = os.environ | settings.to_environment()
    worker = Popen(tied("-c", TOLD_IN_AN_IMPORT), env=environment)
    try:
        assert worker.wait(30) == 0
    finally:
        worker.kill()
        worker.wait()


def test_the_worker_gets_sigterm_as_a_job_comes(
    store: Store, redis: Redis, dataset_id: str, settings: WorkerSettings
) -> None:
    fit = queue(store, redis, dataset_id, LONG)
    worker = Popen(tied("-c", TOLD_BEFORE_THE_JOB), env=os.environ | settings.to_environment())
    try:
        assert worker.wait(30) == 0
        assert lookup.get(store, FitRecord, fit.id).status in ("queued", "running")
    finally:
        worker.kill()
        worker.wait()


# A worker that loses what it needs as a job comes, and gets SIGTERM before it tries again.
TOLD_IN_AN_OUTAGE = """
import os, signal
from worker import runner
from worker.settings import WorkerSettings

class Cut(runner.JobWorker):
    def execute_job(self, job, queue):
        raise OSError("gone")

runner.JobWorker = Cut
runner.time.sleep = lambda seconds: os.kill(os.getpid(), signal.SIGTERM)
runner.run(WorkerSettings())
"""


def test_the_worker_gets_sigterm_in_an_outage(
    store: Store, redis: Redis, dataset_id: str, settings: WorkerSettings
) -> None:
    queue(store, redis, dataset_id, LONG)
    environment = os.environ | settings.to_environment()
    done = run(tied("-c", TOLD_IN_AN_OUTAGE), env=environment, timeout=60)
    assert done.returncode in (0, -signal.SIGTERM), done.stderr
