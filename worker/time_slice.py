"""Sharing workers: how long a lift or a fit may keep one, and how others help with a lift."""

import time
from contextlib import suppress

from redis import Redis
from redis.exceptions import RedisError
from sqlalchemy.exc import SQLAlchemyError

from store import lifts
from store.database import Store
from store.records import FitRecord
from worker.fair_order import others_wait
from worker.queue import offer, open_queues
from worker.settings import WorkerSettings

LOOK_SECONDS = 1.0  # between two looks at who waits: an idle worker takes it within that time


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


class FitTurn:
    """One attempt's turn at a worker, which it gives up to others that wait."""

    def __init__(
        self, connection: Redis, store: Store, settings: WorkerSettings, fit: FitRecord
    ) -> None:
        self._queues = open_queues(connection, settings.queues)
        self._store, self._job_id = store, fit.job_id
        self._seconds = settings.fit_turn_seconds
        self._ends = time.monotonic() + self._seconds
        self._seen: set[str] = set()

    def is_over(self) -> bool:
        """Return whether the worker should go on with work of others.

        That was seen to wait twice, so no other worker was free for it. While queues or records are
        away, the turn goes on.
        """
        if time.monotonic() < self._ends:
            return False
        seen: set[str] = set()
        with suppress(RedisError, SQLAlchemyError):
            seen = others_wait(self._store, self._queues, self._job_id)
        still = bool(seen & self._seen)
        self._seen = seen
        self._ends = time.monotonic() + LOOK_SECONDS
        return still

    def begin_again(self) -> None:
        """Begin another turn, as this one could not be given up."""
        self._ends = time.monotonic() + self._seconds
