"""The queue's contract: its name, its job, what a job may say."""

import io
import json
import pickle
from typing import Any

from redis import Redis
from redis.backoff import ExponentialWithJitterBackoff
from redis.retry import Retry
from rq import Queue
from rq.job import Job

from models.config import FitConfig
from store.records import Fit

QUEUE = "fits"
FIT_JOB = "worker.jobs.fit"

RESULT_SECONDS = 24 * 3600
FAILURE_SECONDS = 7 * 24 * 3600


class PlainDataSerializer:
    """Reads jobs from any RQ producer, whichever of RQ's serializers it uses, as plain data.

    RQ's default writes pickles, which can run code when they are read. Only strings, numbers,
    lists, tuples, dictionaries and the like are accepted here: a pickle that names any class or
    function is refused before it can do anything.
    """

    @staticmethod
    def dumps(value: Any) -> bytes:
        """Write plain data as RQ's default serializer does, so that any producer can read it."""
        return pickle.dumps(value)

    @staticmethod
    def loads(data: bytes) -> Any:
        """Read plain data; raise ``pickle.UnpicklingError`` or ``ValueError`` for anything else."""
        if data[:1] in (b"[", b"{", b'"'):  # a pickle starts otherwise
            return json.loads(data)
        return _PlainDataUnpickler(io.BytesIO(data)).load()


class _PlainDataUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(
            f"A job's arguments must be plain data; this one holds {module}.{name}."
        )

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("A job's arguments must be plain data.")


class FitJob(Job):
    """A job that may call :data:`FIT_JOB` and nothing else: no other function, no callbacks."""

    success_callback = failure_callback = stopped_callback = None

    def check_function(self) -> None:
        """Raise ``ValueError`` if the job asks for another function."""
        if self.func_name != FIT_JOB or self.instance is not None:
            raise ValueError(f"This queue runs {FIT_JOB!r} only, not {self.func_name!r}.")

    @property
    def func(self) -> Any:
        """Return the job function."""
        self.check_function()
        return super().func


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


def open_queue(connection: Redis) -> Queue:
    """Return the queue that carries fits."""
    return Queue(QUEUE, connection=connection, job_class=FitJob, serializer=PlainDataSerializer)


def enqueue(queue: Queue, fit: Fit) -> None:
    """Put a recorded fit on the queue, as any producer would.

    Twice is harmless: only one job can claim the fit.
    """
    queue.enqueue(
        FIT_JOB,
        kwargs={"dataset_id": fit.dataset_id, "config": fit.config, "name": fit.name},
        job_id=fit.job_id,
        result_ttl=RESULT_SECONDS,
        failure_ttl=FAILURE_SECONDS,
        meta={"fit_id": fit.id},
    )


def parse_request(
    dataset_id: object, config: object = None, name: object = None
) -> tuple[str, FitConfig, str]:
    """Check a job's arguments.

    Returns
    -------
    tuple
        Dataset identifier, configuration with its defaults filled in, name of the fit.

    Raises
    ------
    ValueError
        Naming the argument at fault (pydantic's ``ValidationError`` is one).
    """
    if not isinstance(dataset_id, str):
        raise ValueError(f"dataset_id must be a string, got {type(dataset_id).__name__}")
    if not isinstance(name, str | None):
        raise ValueError(f"name must be a string, got {type(name).__name__}")
    checked = FitConfig.model_validate({} if config is None else config)
    return dataset_id, checked, (name or "fit")[:200]
