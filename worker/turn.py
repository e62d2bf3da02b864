"""Sharing workers: how long a lift of days may keep one, and how others come to help."""

import logging
import time
from contextlib import suppress

from redis.exceptions import RedisError
from rq import Queue

from store import lifts
from store.database import Store
from worker.queue import enqueue
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)


class Turn:
    """One helper's time with a worker."""

    def __init__(self, queue: Queue, settings: WorkerSettings, lift_id: str) -> None:
        self._queue = queue
        self._settings = settings
        self._lift_id = lift_id
        self._started = time.monotonic()

    def call_next(self, store: Store, job_id: str) -> None:
        """Have another worker help, if there is one without work and chunks for it to do."""
        lift = lifts.call_next(store, self._lift_id, job_id)
        if lift is not None:
            try:
                enqueue(self._queue, lift)
            except RedisError:
                logger.warning(
                    "The queue is away: a reconciler will call for help with %s", lift.id
                )

    def is_over(self) -> bool:
        """Tell whether the worker is to be given back: other work has waited long enough."""
        lasted = time.monotonic() - self._started
        if lasted > self._settings.max_fit_seconds:  # before RQ ends the job
            return True
        if lasted > self._settings.lift_turn_seconds:
            with suppress(RedisError):
                waiting = self._queue.get_job_ids()
                return any(lifts.helped_by(job_id) != self._lift_id for job_id in waiting)
        return False
