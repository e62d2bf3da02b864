"""The heartbeat of a running attempt: it renews the lease and watches for a cancel."""

import contextvars
import logging
import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from sqlalchemy.exc import SQLAlchemyError

from store.errors import LeaseLostError

logger = logging.getLogger(__name__)

BEAT_SECONDS = 0.25


class Heartbeat:
    """Keeps the lease of what this process works at and publishes its progress, from a thread.

    So the lease lives however long loading the libraries, or one step, may take.

    Attributes
    ----------
    progress
        To be published with the next beat.
    cancel
        The user asked to stop.
    leave
        SIGTERM came: save what there is, give the work back to the queue, and go.
    lost
        The work has ended, or belongs to somebody else by now: do nothing more.
    """

    def __init__(self, beat: Callable[[dict[str, Any] | None], bool | None]) -> None:
        """Prepare to beat.

        Parameters
        ----------
        beat
            Keeps the lease and publishes progress, if there is any news; returns whether the user
            asked to stop; raises ``LeaseLostError``.
        """
        self.progress: dict[str, Any] | None = None
        self.cancel = self.leave = self.lost = False
        self._keep = beat
        self._stop = threading.Event()
        of_job = contextvars.copy_context()  # for the log
        self._thread = threading.Thread(
            target=of_job.run, args=[self._beat], name="heartbeat", daemon=True
        )

    def __enter__(self) -> Self:
        """Start beating, and take SIGTERM."""
        self._previous = signal.signal(signal.SIGTERM, self._on_sigterm)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop beating."""
        self._stop.set()
        self._thread.join()
        signal.signal(signal.SIGTERM, self._previous)

    def _on_sigterm(self, _number: int, _frame: FrameType | None) -> None:
        self.leave = True

    def _beat(self) -> None:
        published = None
        while not self._stop.wait(BEAT_SECONDS):
            progress = self.progress
            try:
                self.cancel = bool(self._keep(None if progress is published else progress))
                published = progress
            except LeaseLostError:
                self.lost = True
                return
            except SQLAlchemyError:  # the lease outlives a short outage of the records
                logger.exception("Could not publish progress")
