"""When a fit is expected to start and to end."""

import threading
import time
from datetime import UTC, datetime
from functools import partial

from fastapi import APIRouter, Request
from pydantic import BaseModel, ConfigDict, Field
from redis import Redis

from service.http.errors import problems
from service.resources.fits import FitDep
from service.resources.jobs import JobStatus
from store import jobs
from store.database import Store
from store.records import FitRecord
from worker.schedule import Forecast, schedules
from worker.settings import WorkerSettings

router = APIRouter(prefix="/fits", tags=["fits"])

ENDED = Forecast(ahead=0, start=None, end=None, workers=0, measured=0, priority="")
KNOWN_SECONDS = 2.0  # for how long an answer holds, or longer where it took long
SHARE = 20


class FitSchedule(BaseModel):
    """When a fit is expected to start and to end, as the queue is now."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "status": "queued",
                "ahead": 3,
                "expected_start": "2026-03-01T09:33:10Z",
                "expected_end": "2026-03-01T09:33:52Z",
                "workers": 2,
                "measured_fits": 50,
            }
        }
    )

    status: JobStatus
    ahead: int = Field(
        description="Fits that wait now and are expected to start before it: projects take turns, "
        "and of each the most urgent ones come first."
    )
    expected_start: datetime | None = Field(
        description="Once it has started, when. Null where no worker takes from its queue or no "
        "duration is known."
    )
    expected_end: datetime | None = Field(
        description="Once it has ended, when. Else null as `expected_start` is."
    )
    workers: int = Field(description="Those that take from its queue; 0 once it has ended.")
    measured_fits: int = Field(
        description="Of how many fits of this deployment durations are known: the last 50, and of "
        "these the ones of like size count, with what more work took of others."
    )


class Schedules:
    """What is expected of all fits, for those who ask one process.

    To play the queues through takes a while where many wait: it is done for all who ask, and no
    more than a twentieth of the time.
    """

    def __init__(self, store: Store, redis: Redis, settings: WorkerSettings) -> None:
        """Know nothing yet."""
        self._play = partial(schedules, store, redis, settings.fit_turn_seconds)
        self._playing = threading.Lock()
        self._known: dict[str, Forecast] = {}
        self._until = 0.0

    def find(self, fit: FitRecord) -> Forecast:
        """Return what is expected of a fit; raise ``RedisError`` if the queue is away."""
        if fit.status in jobs.TERMINAL:
            return ENDED
        with self._playing:
            began = time.monotonic()
            known = self._known.get(fit.id, ENDED)  # whose priority is that of none
            if began >= self._until or known.priority != fit.priority:
                self._known = self._play()
                now = time.monotonic()
                self._until = now + max(KNOWN_SECONDS, SHARE * (now - began))
            return self._known.get(fit.id, ENDED)


@router.get("/{fit_id}/schedule", responses=problems("not_found", "unavailable"))
def get_fit_schedule(fit: FitDep, request: Request) -> FitSchedule:
    """Return when a fit is expected to start and to end, from durations that were measured.

    Fits that are queued later, and lifts, can delay it. Ask again every few seconds.
    """
    known: Schedules = request.app.state.schedules
    found = known.find(fit)
    return FitSchedule(
        status=fit.status,
        ahead=found.ahead,
        expected_start=_moment(found.start if fit.started_at is None else fit.started_at),
        expected_end=_moment(found.end if fit.finished_at is None else fit.finished_at),
        workers=found.workers,
        measured_fits=found.measured,
    )


def _moment(seconds: float | None) -> datetime | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
