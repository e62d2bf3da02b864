"""Sharing workers: how long a long lift may keep one, and how others help."""

import time
from contextlib import suppress

from redis import Redis
from redis.exceptions import RedisError

from store import lifts
from store.database import Store
from worker.queue import offer, open_queues
from worker.settings import WorkerSettings


class TimeSlice:
    """One helper's time with a worker."""

    def __init__(self, connection: Redis, settings: WorkerSettings, lift_id: str) -> None:
        self._connection = connection
        self._settings = settings
        self._lift_id = lift_id
        self._ends = time.monotonic() + settings.lift_turn_seconds
        self._last = time.monotonic() + settings.max_fit_seconds  # then RQ soon ends the job

    def call_next(self, store: Store, job_id: str) -> None:
        """Have another worker help, if there is one without work and chunks for it to do."""
        lift = lifts.call_next(store, self._lift_id, job_id)
        if lift is not None:
            offer(self._connection, store, lift)

    def is_over(self) -> bool:
        """Return whether the worker should stop for other waiting work.

        The queues are asked once a turn, because every question takes seconds while they are away.
        """
        now = time.monotonic()
        if now < self._ends:
            return now > self._last
        self._ends = now + self._settings.lift_turn_seconds  # if no job waits, another turn begins
        with suppress(RedisError):
            return any(
                lifts.helped_by(job_id) != self._lift_id
                for queue in open_queues(self._connection, self._settings.queues)
                for job_id in queue.get_job_ids()
            )
        return False
