"""The worker process: it waits for jobs and runs each in a separate process."""

import logging
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from typing import Any

import redis.exceptions
from obstore.exceptions import BaseError as ObjectStoreError
from redis import Redis
from redis.client import Pipeline
from rq import Queue, Worker
from rq.exceptions import StopRequested
from rq.job import Job, JobStatus
from rq.registry import StartedJobRegistry
from rq.utils import now
from rq.worker import DequeueStrategy
from sqlalchemy.exc import SQLAlchemyError

from store import fits, housekeeping, jobs, lifts, webhooks
from store.database import Store
from store.private import keep_private
from store.records import FitRecord, LiftRecord
from worker import at_work, logs
from worker.beside import FORK, Beside
from worker.contract import RESULT_SECONDS, KnownJob, PlainDataSerializer, is_of_wrong_type
from worker.fair_order import bring_forward, note_turn
from worker.housekeeping import keep_house
from worker.process import tie_forks
from worker.queue import (
    WorkQueue,
    check_reachable,
    connect,
    enqueue,
    open_queues,
)
from worker.reconciler import Reconciler
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

IDLE_SECONDS = 2  # how long to wait for a job before looking after the records again
MONITOR_SECONDS = 1  # the same while a job runs
CANCEL_PATIENCE_SECONDS = 0.7  # before a job that does not heed a cancel loses its process
TIMEOUT_SLACK_SECONDS = 300  # the fit ends itself; RQ's timeout is for one that hangs
REDIS_RETRIES = 12
ASK_SECONDS = 300  # between two looks whether the objects are to be swept
REDIS_AWAY = (redis.exceptions.ConnectionError, redis.exceptions.TimeoutError)


class JobWorker(Worker):
    """RQ's worker, which also keeps records and queues in step."""

    def __init__(self, connection: Redis, settings: WorkerSettings, store: Store) -> None:
        super().__init__(
            open_queues(connection, settings.queues),
            connection=connection,
            job_class=KnownJob,
            queue_class=WorkQueue,
            serializer=PlainDataSerializer,
            job_monitoring_interval=MONITOR_SECONDS,
            default_result_ttl=RESULT_SECONDS,
            log_job_description=False,
        )
        self.stopping = False
        self._settings = settings
        self._store = store
        self._reconciler = Reconciler(store, connection, settings)
        self._rounds = 0
        self._asked_at = time.monotonic()  # the first jobs are not delayed by housekeeping
        self._sweep = Beside(keep_house, settings)
        self._delivery = Beside(_deliver, settings)

    @property
    def dequeue_timeout(self) -> int:
        """Seconds to wait for a job before the next heartbeat."""
        return IDLE_SECONDS

    def heartbeat(self, timeout: int | None = None, pipeline: Pipeline | None = None) -> None:
        """Report to Redis that this worker lives, and update the records."""
        super().heartbeat(timeout, pipeline)
        if pipeline is None and not self.is_horse:
            looked = self._look_after_records()
            # The first comes before any job is looked for, the second may come before one is begun.
            self._rounds += 1
            if looked and self._rounds > 2:
                at_work.leave_sign(self.connection, self.key)

    def maintain_heartbeats(self, job: Job) -> None:
        """Do the same while a job runs, and stop it if it does not heed a cancel."""
        super().maintain_heartbeats(job)
        if self.stopping:
            self._have_job_saved()  # it may not have been there yet when SIGTERM came
        if self._look_after_records(job):
            at_work.leave_sign(self.connection, self.key)

    def run_maintenance_tasks(self) -> None:
        """Clean RQ's registries; errors in them do not stop this worker."""
        try:
            super().run_maintenance_tasks()  # type: ignore[no-untyped-call]
        except (StopRequested, *REDIS_AWAY):
            raise
        except Exception:
            logger.exception("RQ's registries cannot be cleaned")
            self.last_cleaned_at = now()  # type: ignore[assignment]

    def _look_after_records(self, job: Job | None = None) -> bool:
        """Return whether records and queue are in step, as far as the records can be reached."""
        in_step = True
        try:
            with logs.of_job(None):  # it looks after those of all jobs
                self._reconciler.step()
                if job is None:  # this worker is about to take one
                    bring_forward(self._store, self.queues)
            if job is not None and any(
                cancelled(self._store, job.id, patience_seconds=CANCEL_PATIENCE_SECONDS)
                for cancelled in (fits.enforce_cancel, lifts.was_cancelled)
            ):
                logger.warning("Job %s did not stop when asked: killing it", job.id)
                self.kill_horse()
            self._sweep_if_due()
            if not self._delivery.is_running() and webhooks.any_due(self._store):
                self._delivery.start()
        except (StopRequested, redis.exceptions.RedisError):
            raise
        except Exception as error:
            if self.stopping and not self._stop_requested:
                raise StopRequested from error  # SIGTERM raised it, and a library wrapped it
            in_step = isinstance(error, SQLAlchemyError)
            if in_step:
                self._reconciler.unsettle()
            logger.exception(
                "The records cannot be reached"
                if in_step
                else "Records and queue cannot be kept in step"
            )
        return in_step

    def _sweep_if_due(self) -> None:
        if self._sweep.is_running() or time.monotonic() - self._asked_at < ASK_SECONDS:
            return
        self._asked_at = time.monotonic()
        if housekeeping.take_turn(self._store):
            self._sweep.start()

    def execute_job(self, job: Job, queue: Queue) -> None:
        """Run a job in a separate process, whatever limits its producer set or left out.

        It is recorded before it runs, and until then stays where reconcilers find it. So it cannot
        be lost if that process, or this one, ends.
        """
        assert isinstance(queue, WorkQueue)  # noqa: S101 (this worker has no others)
        if not self._reconciler.adopt(queue, job.id):
            return
        with suppress(SQLAlchemyError):  # then it has its turn without a note
            note_turn(self._store, self.connection, job.id)
        job.origin = queue.name  # whatever its producer wrote
        job.timeout = self._settings.max_fit_seconds + TIMEOUT_SLACK_SECONDS
        try:
            with logs.of_job(job.id, job.meta.get("request_id")):
                super().execute_job(job, queue)
                self._put_back(job, queue)
        except StopRequested:
            raise
        except Exception as error:
            away = isinstance(error, redis.exceptions.RedisError) and not is_of_wrong_type(error)
            logger.exception("Job %s: %s", job.id, "Redis is away" if away else "cannot go on")
            if self.horse_pid:  # the record is the truth: a job can finish without Redis
                self.wait_for_horse()
            if away:
                raise
            queue.intermediate_queue.set_aside(job.id.encode())
        if not self.stopping:
            _import_for_later_jobs()
        if self.stopping:  # an import may take for its own what SIGTERM raises in it
            raise StopRequested

    def _put_back(self, job: Job, queue: Queue) -> None:
        """Put a fit back on its queue that has ended its turn; it comes first of its key's."""
        if self.stopping or job.get_status(refresh=True) != JobStatus.FINISHED:
            return
        fit = None
        with suppress(SQLAlchemyError):  # then the reconciler does it
            fit = jobs.by_job(self._store, FitRecord, job.id)
        if fit is not None and fit.status == "queued":
            asked_by = job.meta.get("request_id")
            enqueue(queue, fit, asked_by if isinstance(asked_by, str) else None, at_front=True)

    def handle_exception(self, job: Job, *exc_info: Any) -> None:
        """Log why a job ended: one line if the record has the reason, else with the traceback."""
        why = self._recorded_failure(job)
        if why is None:
            super().handle_exception(job, *exc_info)
        else:
            logger.warning("Job %s failed: %s", job.id, why)

    def handle_job_failure(
        self,
        job: Job,
        queue: Queue,
        started_job_registry: StartedJobRegistry | None = None,
        exc_string: str = "",
    ) -> None:
        """Store in RQ why a job failed: one line if the record has the reason."""
        why = self._recorded_failure(job)
        exc_string = exc_string if why is None else f"RuntimeError: {why}"
        super().handle_job_failure(job, queue, started_job_registry, exc_string)

    def _recorded_failure(self, job: Job) -> str | None:
        """Return code and message of the fit or the lift that a job asked for, if it failed.

        None for a fault of Fewview: then the exception has the details.
        """
        with suppress(SQLAlchemyError):
            record = jobs.by_job(self._store, FitRecord, job.id) or jobs.by_job(
                self._store, LiftRecord, job.id
            )
            if record is not None and record.error and record.error["code"] != "internal_error":
                return f"{record.error['code']}: {record.error['message']}"
        return None

    def prepare_job_execution(
        self,
        job: Job,
        remove_from_intermediate_queue: bool = True,
    ) -> None:
        """Note in Redis that a job runs; it need not be found again any more if it does."""
        super().prepare_job_execution(job, remove_from_intermediate_queue=True)

    def handle_warm_shutdown_request(self) -> None:
        """Make the running job save its state and go back to the queue, then leave."""
        super().handle_warm_shutdown_request()  # type: ignore[no-untyped-call]
        self.stopping = True
        self._have_job_saved()

    def _have_job_saved(self) -> None:
        if self.horse_pid:
            with suppress(ProcessLookupError):
                os.kill(self.horse_pid, signal.SIGTERM)


def _import_for_later_jobs() -> None:
    """Import what takes seconds, once: the processes of later jobs are forked from this one.

    Not before the first job is done: it would wait, taken from the queue and not begun.
    """
    import worker.fitting  # noqa: PLC0415
    import worker.lifting  # noqa: F401, PLC0415


def _deliver(settings: WorkerSettings) -> None:
    from worker.webhooks import deliver  # noqa: PLC0415 (few workers ever need it)

    deliver(settings)


def _open_store(settings: WorkerSettings) -> None:
    """Check that records and objects can be used; errors can go from one process to another."""
    try:
        Store(settings).close()
    except (SQLAlchemyError, ObjectStoreError) as error:
        raise OSError(f"records and objects cannot be reached: {error}") from None


def run(settings: WorkerSettings) -> None:
    """Work until SIGTERM or SIGINT, through outages of Redis and of the records.

    Raises
    ------
    ValueError
        If the settings name no Redis, or one that does not answer as the worker starts.
    StoreError
        If the records are of another version, or do not belong to the objects.
    """
    if settings.redis_url is None:
        raise ValueError("A worker needs FEWVIEW_REDIS_URL, for example redis://localhost:6379/0.")
    check_reachable(settings.redis_url)
    keep_private(settings)
    tie_forks()  # work-horses, the sweep, and what opens the records first
    stopping = False
    while not stopping:
        try:
            connection = connect(str(settings.redis_url), retries=REDIS_RETRIES)
            at_work.note_start(connection)
            with ProcessPoolExecutor(1, mp_context=FORK) as apart:  # this process will fork
                apart.submit(_open_store, settings).result()
            store = Store(settings, forks=True)
            worker = JobWorker(connection, settings, store)
            try:
                worker.work(logging_level="WARNING", dequeue_strategy=DequeueStrategy.ROUND_ROBIN)
            finally:
                stopping = worker.stopping
                for number in (signal.SIGINT, signal.SIGTERM):  # it would raise from anywhere
                    signal.signal(number, signal.SIG_DFL)
        except (redis.exceptions.RedisError, SQLAlchemyError, OSError):
            logger.exception("Cannot work; trying again")
        if not stopping:
            time.sleep(1)
