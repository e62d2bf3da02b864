"""Putting back what the queue lost, and recording what others put on it."""

import logging
import time

from redis import Redis
from rq import Queue
from rq.exceptions import DeserializationError

from store import fits
from store.database import Store
from store.errors import ConfigError, NotFoundError
from worker.queue import FitJob, enqueue, open_queue, parse_request

logger = logging.getLogger(__name__)

GRACE_SECONDS = 2.0
ARGUMENTS = ("dataset_id", "config", "name")  # of a job, in this order


class Reconciler:
    """Keeps records and queue in step. Every worker runs one; running many is harmless."""

    def __init__(self, store: Store, connection: Redis) -> None:
        self._store = store
        self._queue: Queue = open_queue(connection)
        self._lost_since: dict[str, float] = {}
        self._known: set[str] = set()

    def step(self) -> None:
        """Adopt jobs without a record; queue again the fits that no job carries.

        A fit must be without a job for a while: between leaving the queue and being claimed, a
        job is in neither place for a moment.
        """
        waiting = self._queue.get_job_ids()
        for job_id in waiting:
            if job_id not in self._known:
                self._adopt(job_id)
        self._known.intersection_update(waiting)  # bounded by the queue's length
        now = time.monotonic()
        carried = set(waiting)
        lost = [fit for fit in fits.recover(self._store) if fit.job_id not in carried]
        self._lost_since = {fit.id: self._lost_since.get(fit.id, now) for fit in lost}
        for fit in lost:
            if now - self._lost_since[fit.id] >= GRACE_SECONDS:
                logger.warning("Fit %s was on no queue: putting it back", fit.id)
                self._queue.intermediate_queue.remove(fit.job_id)
                enqueue(self._queue, fit)
                del self._lost_since[fit.id]

    def _adopt(self, job_id: str) -> None:
        self._known.add(job_id)
        if fits.by_job(self._store, job_id) is None:
            job = self._queue.fetch_job(job_id)
            if job is not None and isinstance(job, FitJob):
                adopt(self._store, job)


def adopt(store: Store, job: FitJob) -> str:
    """Record the fit that a job asks for, whoever queued it; return its identifier.

    A job that can never run is recorded as a failed fit, so that its producer can read why.
    """
    arguments: dict[str, object] = {}
    try:
        job.check_function()
        if len(job.args) > len(ARGUMENTS):
            raise ValueError(f"expected {', '.join(ARGUMENTS)}, got {len(job.args)} arguments")
        arguments = dict(zip(ARGUMENTS, job.args, strict=False))
        arguments |= job.kwargs
        if unknown := sorted(set(arguments) - set(ARGUMENTS)):
            raise ValueError(f"{unknown[0]}: expected some of {', '.join(ARGUMENTS)}")
        dataset_id, config, name = parse_request(**arguments)
        fit_id = fits.create(
            store,
            dataset_id=dataset_id,
            name=name,
            config=config.model_dump(mode="json"),
            job_id=job.id,
        ).id
    except (DeserializationError, TypeError, ValueError, NotFoundError, ConfigError) as error:
        code = "dataset_not_found" if isinstance(error, NotFoundError) else "invalid_arguments"
        fit_id = fits.refuse(
            store,
            dataset_id=str(arguments.get("dataset_id", ""))[:200],
            name=str(arguments.get("name") or "fit")[:200],
            config={},
            job_id=job.id,
            error={"code": code, "message": str(error.__cause__ or error)},
        )
    job.meta["fit_id"] = fit_id
    job.save_meta()  # type: ignore[no-untyped-call]
    return fit_id
