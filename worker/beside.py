"""Work that a worker does beside its jobs, each in a process that is forked for it."""

import logging
import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.context import ForkProcess

import redis.exceptions
from obstore.exceptions import BaseError as ObjectStoreError
from sqlalchemy.exc import SQLAlchemyError

from store.errors import StoreError
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

FORK = multiprocessing.get_context("fork")


class Beside:
    """Work that one process at a time does.

    The worker itself does not do it. The threads that it needs would not live on in a forked
    work-horse, which would wait for them forever.
    """

    def __init__(self, work: Callable[[WorkerSettings], None], settings: WorkerSettings) -> None:
        self._work, self._settings = work, settings
        self._process: ForkProcess | None = None

    def is_running(self) -> bool:
        """Return whether the process that was started last is still running."""
        if self._process is not None and not self._process.is_alive():
            self._process.close()
            self._process = None
        return self._process is not None

    def start(self) -> None:
        """Start a process that does the work, once."""
        self._process = FORK.Process(
            target=_carry_out, args=(self._work, self._settings), daemon=True
        )
        self._process.start()


def _carry_out(work: Callable[[WorkerSettings], None], settings: WorkerSettings) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):  # which the worker takes for itself
        signal.signal(number, signal.SIG_DFL)
    try:
        work(settings)
    except (StoreError, SQLAlchemyError, ObjectStoreError, OSError, redis.exceptions.RedisError):
        logger.exception("What a worker does beside its jobs cannot be done")
