"""The queues: lists in Redis of which no job is lost, and putting jobs on them."""

import logging
import time
from collections.abc import Sequence
from typing import cast

from pydantic import AnyUrl
from redis import Redis
from redis.backoff import ExponentialWithJitterBackoff
from redis.exceptions import RedisError
from redis.retry import Retry
from rq import Queue
from rq.exceptions import DequeueTimeout
from rq.intermediate_queue import IntermediateQueue
from rq.job import Job
from rq.registry import CanceledJobRegistry
from sqlalchemy.exc import SQLAlchemyError

from store.database import Store
from store.jobs import waiting_job
from store.records import FitRecord, LiftRecord
from store.settings import shown
from worker import logs
from worker.contract import (
    FAILURE_SECONDS,
    FIT_JOB,
    HELP_JOB,
    JOB_ID,
    RESULT_SECONDS,
    KnownJob,
    PlainDataSerializer,
)
from worker.needs import queue_for
from worker.settings import QUEUES, QueueName

logger = logging.getLogger(__name__)

START_PATIENCE_SECONDS = 3.0
POLL_SECONDS = 0.1  # between two looks at several queues


def connect(url: str, *, retries: int, timeout_seconds: float = 5.0) -> Redis:
    """Return a client that rides over ``retries`` failures (a restart of Redis) at up to 1 s each.

    A name that cannot be reached is only noticed at the first command.

    Parameters
    ----------
    timeout_seconds
        How long Redis may take to accept a connection or to answer, at each try.
    """
    return Redis.from_url(
        url,
        retry=Retry(ExponentialWithJitterBackoff(base=0.05, cap=1.0), retries),
        socket_connect_timeout=timeout_seconds,
        socket_timeout=timeout_seconds,
        health_check_interval=30,
    )


def check_reachable(url: AnyUrl) -> None:
    """Raise ``ValueError``, with a message for the user, if Redis does not answer now."""
    try:
        with connect(str(url), retries=0, timeout_seconds=START_PATIENCE_SECONDS) as connection:
            connection.ping()
    except RedisError as error:
        raise ValueError(
            f"Redis at {shown(url)} cannot be reached ({error}): start it, or give its address "
            "it is with --redis-url."
        ) from error


class Taken(IntermediateQueue):
    """The jobs between a queue and a worker: where they are found again if that one dies."""

    def get_job_ids(self) -> list[str]:
        """Return their identifiers."""
        return [name.decode() for name in self._names() if JOB_ID.fullmatch(name) is not None]

    def misnamed(self) -> list[bytes]:
        """Return what a worker has met that can be no job's identifier."""
        return [name for name in self._names() if JOB_ID.fullmatch(name) is None]

    def _names(self) -> list[bytes]:
        return cast(list[bytes], self.connection.lrange(self.key, 0, -1))

    def set_aside(self, name: bytes) -> None:
        """Take away what can be no job; its producer reads that the job failed."""
        job = Job.redis_job_namespace_prefix.encode() + name
        if self.connection.type(job) == b"hash":
            self.connection.hset(job, "status", "failed")
            self.connection.expire(job, FAILURE_SECONDS)
        self.connection.lrem(self.key, 0, name)  # type: ignore[arg-type]


class WorkQueue(Queue):
    """A queue of which no job is lost between it and a worker, however many that one takes from.

    Other producers may have written anything: what can be no job's identifier goes where jobs are
    found again, and is set aside there by the reconciler.
    """

    def get_job_ids(self, offset: int = 0, length: int = -1) -> list[str]:
        """Return the identifiers of the jobs that wait."""
        end = offset + length - 1 if length >= 0 else length
        found = cast(list[bytes], self.connection.lrange(self.key, offset, end))
        return [name.decode() for name in found if JOB_ID.fullmatch(name) is not None]

    @property
    def intermediate_queue(self) -> Taken:
        """The jobs that a worker has taken and not begun."""
        return Taken(self.key, connection=self.connection)

    def has_work(self) -> bool:
        """Return whether jobs wait, including those that a worker has taken and not begun."""
        return bool(self.connection.exists(self.key, self.intermediate_queue_key))

    @classmethod
    def lmove(
        cls, connection: Redis, queue_key: str, timeout: int | None
    ) -> tuple[str, bytes] | None:
        """Do as RQ does, which could not go on from what is no job's identifier."""
        found: tuple[str, bytes] | None = super().lmove(connection, queue_key, timeout)
        if found is None or JOB_ID.fullmatch(found[1]) is not None:
            return found
        if timeout is None:
            return None
        raise DequeueTimeout(timeout, queue_key)

    @classmethod
    def lpop(
        cls, queue_keys: Sequence[str], timeout: int | None, connection: Redis | None = None
    ) -> tuple[str, bytes] | None:
        """Move the next job of several queues to where it is found again if this worker dies now.

        RQ does so where there is one queue only. Raises ``DequeueTimeout`` as RQ does.
        """
        ends = time.monotonic() + (timeout or 0)
        while True:
            for key in queue_keys:
                found = cls.lmove(connection, key, None)  # type: ignore[arg-type]
                if found is not None:
                    return found
            if timeout is None:
                return None
            if time.monotonic() >= ends:
                raise DequeueTimeout(timeout, queue_keys)
            time.sleep(POLL_SECONDS)


def open_queue(connection: Redis, name: QueueName = "fits") -> WorkQueue:
    """Return a queue by its name."""
    return WorkQueue(
        name, connection=connection, job_class=KnownJob, serializer=PlainDataSerializer
    )


def open_queues(connection: Redis, names: Sequence[QueueName] = QUEUES) -> list[WorkQueue]:
    """Return several queues, by default all there are."""
    return [open_queue(connection, name) for name in names]


def forget_cancelled(queue: Queue) -> None:
    """Delete jobs that their producers cancelled long ago; RQ would keep them for good."""
    registry = CanceledJobRegistry(queue=queue)
    long_ago = time.time() - FAILURE_SECONDS
    for job_id in registry.get_job_ids(cleanup=False):
        if (queue.connection.zscore(registry.key, job_id) or 0.0) < long_ago:
            registry.remove(job_id)
            queue.connection.delete(Job.key_for(job_id))  # which need not be read for that


def enqueue(
    queue: Queue,
    record: FitRecord | LiftRecord,
    asked_by: str | None = None,
    *,
    at_front: bool = False,
) -> None:
    """Put a recorded fit on the queue, as any producer would, or a call for help with a lift.

    Twice is harmless: only one job can claim the fit, or a chunk of the lift.

    Parameters
    ----------
    asked_by
        The identifier of the request that asked for it, for the worker's log.
    at_front
        Whether it comes before others of its key.
    """
    if isinstance(record, FitRecord):
        function, job_id = FIT_JOB, record.job_id
        arguments = {"dataset_id": record.dataset_id, "config": record.config, "name": record.name}
        if record.from_model is not None:
            arguments["from_model"] = record.from_model
    else:
        function, job_id = HELP_JOB, waiting_job(record)
        arguments = {"lift_id": record.id}
    queue.enqueue(
        function,
        kwargs=arguments,
        job_id=job_id,
        at_front=at_front,
        result_ttl=RESULT_SECONDS,
        failure_ttl=FAILURE_SECONDS,
        meta={f"{record.noun}_id": record.id}
        | ({} if asked_by is None else {"request_id": asked_by}),
    )


def enqueue_again(connection: Redis, store: Store, record: FitRecord | LiftRecord) -> None:
    """Put on the queue what was lost there, for the same request, if an earlier job names it."""
    earlier = [record.job_id]
    if isinstance(record, LiftRecord):
        earlier.insert(0, waiting_job(record))
    jobs = KnownJob.fetch_many(earlier, connection, PlainDataSerializer)
    noted = (job.meta.get("request_id") for job in jobs if job is not None)
    asked_by = next((name for name in noted if isinstance(name, str)), None)
    enqueue(open_queue(connection, queue_for(store, record)), record, asked_by)


def offer(connection: Redis, store: Store, record: FitRecord | LiftRecord) -> None:
    """Do the same on the queue for what the record needs, if queue and records can be reached.

    If they cannot, a reconciler will when they are back.
    """
    try:
        queue = open_queue(connection, queue_for(store, record))
        enqueue(queue, record, logs.request_id.get())
    except (RedisError, SQLAlchemyError):
        logger.warning("Queue or records are away: %s is queued when they are back", record.id)
