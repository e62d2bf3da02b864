"""When fits are expected to start and to end.

The order of the queues (`worker.fair_order`) is played through with the workers there are. How long
a fit takes is known from those that this deployment has made: the median of their durations, where
fits of like size count most. Lifts are left out, for they give way, and so is what comes later.
"""

import heapq
import math
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, NamedTuple

from redis import Redis
from rq import Worker
from sqlalchemy import Select, func, select

from store import clock
from store.authors import ALL_PROJECTS
from store.database import Store
from store.jobs import RANKS, Waiting
from store.records import DatasetRecord, FitRecord
from store.shares import NO_KEY, Who
from worker.fair_order import Turns, last_turns
from worker.queue import open_queues

MEASURED = 50  # of the last fits, how many durations are looked at
LIKE = 1.0  # distance of log sizes in which the weight of a duration falls to 1 / e
MOST_TURNS = 100_000  # that are played through


class Expected(NamedTuple):
    """What is expected of a fit that waits or runs.

    Attributes
    ----------
    ahead
        How many fits that wait now start before it.
    start, end
        Seconds since 1970, of its first start; None where nothing was measured, or nobody works.
    workers
        How many workers there are for it.
    measured
        How many durations this is known from.
    """

    ahead: int
    start: float | None
    end: float | None
    workers: int
    measured: int


@dataclass
class _Fit:
    """A fit that has not ended, as it is played through."""

    id: str
    job_id: str
    running: bool
    job: Waiting
    left: float  # seconds
    started: float | None
    starts: float | None = None
    ends: float | None = None


@dataclass
class _Line:
    """The fits that wait on one queue: by project and rank, of each key in their order."""

    waiting: dict[str, dict[int, dict[Who, deque[_Fit]]]] = field(default_factory=dict)

    def add(self, fit: _Fit, *, at_front: bool = False) -> None:
        of_project = self.waiting.setdefault(fit.job.who.project, {})
        fits = of_project.setdefault(fit.job.rank, {}).setdefault(fit.job.who, deque())
        (fits.appendleft if at_front else fits.append)(fit)

    def heads(self) -> Iterator[_Fit]:
        """Yield the first fit of each key, of the most urgent ones of each project."""
        for of_project in self.waiting.values():
            for fits in of_project[min(of_project)].values():
                yield fits[0]

    def remove(self, fit: _Fit) -> None:
        """Remove a fit that is the first of its key."""
        project, rank, who = fit.job.who.project, fit.job.rank, fit.job.who
        of_project = self.waiting[project]
        of_project[rank][who].popleft()
        if not of_project[rank][who]:
            del of_project[rank][who]
        if not of_project[rank]:
            del of_project[rank]
        if not of_project:
            del self.waiting[project]


def expected(store: Store, connection: Redis, fit_id: str, turn_seconds: float) -> Expected | None:
    """Return what is expected of a fit; None if it has ended, or is not there.

    Parameters
    ----------
    turn_seconds
        How long a fit keeps its worker while others wait.
    """
    with store.reading() as session:
        now = clock.read(session)
        durations = _durations(session.execute(_measured(), execution_options=ALL_PROJECTS).all())
        rows = session.execute(_open(), execution_options=ALL_PROJECTS).all()
    fits = [_of_row(row, durations, now) for row in rows]
    mine = next((fit for fit in fits if fit.id == fit_id), None)
    if mine is None:
        return None
    queues = open_queues(connection)
    lines = {queue.name: queue.get_job_ids() for queue in queues}
    workers = [
        frozenset(worker.queue_names())
        for worker in Worker.all(connection)
        if set(worker.queue_names()) & set(lines)
    ]
    here = next((name for name, jobs in lines.items() if mine.job_id in jobs), "fits")
    for_it = sum(here in names for names in workers)
    turns = last_turns(connection, [fit.job.who for fit in fits])
    started = _play(fits, lines, workers, turns, now, turn_seconds)
    ahead = started.index(mine) if mine in started else len(started)
    known = bool(durations) and (mine.running or for_it > 0)
    return Expected(
        0 if mine.running or mine.started is not None else ahead,
        mine.started if mine.started is not None else mine.starts if known else None,
        mine.ends if known else None,
        for_it,
        len(durations),
    )


def _size() -> Any:
    """Return the size of a fit, in SQL: keypoints of all frames and views, times steps."""
    of_frames = FitRecord.frames * DatasetRecord.views * DatasetRecord.keypoints
    return func.coalesce(of_frames, 1) * func.coalesce(FitRecord.config["steps"].as_integer(), 1)


def _measured() -> Select[Any]:
    return (
        select(FitRecord.finished_at - FitRecord.started_at, _size())
        .join(DatasetRecord, DatasetRecord.id == FitRecord.dataset_id)
        .where(FitRecord.status == "succeeded", FitRecord.attempt == 1)
        .order_by(FitRecord.id.desc())
        .limit(MEASURED)
    )


def _open() -> Select[Any]:
    return (
        select(
            FitRecord.id,
            FitRecord.job_id,
            FitRecord.status,
            FitRecord.project,
            FitRecord.key_id,
            FitRecord.priority,
            FitRecord.progress,
            FitRecord.started_at,
            _size(),
        )
        .outerjoin(DatasetRecord, DatasetRecord.id == FitRecord.dataset_id)
        .where(FitRecord.status.in_(("queued", "running")))
        .order_by(FitRecord.id)
    )


def _durations(rows: Sequence[Any]) -> list[tuple[float, float]]:
    """Return seconds and log sizes of fits that were made, the shortest first."""
    return sorted((max(float(took), 1e-3), math.log(max(size, 1))) for took, size in rows)


def _usual(durations: Sequence[tuple[float, float]], size: float) -> float:
    """Return how long a fit of a size takes: the median, fits of like size counting most."""
    if not durations:
        return 1.0  # the order is known all the same
    weights = [math.exp(-abs(known - math.log(max(size, 1))) / LIKE) for _, known in durations]
    at = next(at for at, below in enumerate(accumulate(weights)) if below >= sum(weights) / 2.001)
    return durations[at][0]


def _of_row(row: Any, durations: Sequence[tuple[float, float]], now: float) -> _Fit:
    fit_id, job_id, status, project, key_id, priority, progress, started, size = row
    whole, running = _usual(durations, size), status == "running"
    done = (progress or {}).get("step", 0) / max((progress or {}).get("steps", 1), 1)
    left = (progress or {}).get("seconds_left") if running else None
    if left is None:
        left = whole * (1 - done)
        if running and not done and started is not None:
            left = max(whole - (now - started), 0.0)
    job = Waiting(Who(project, key_id or NO_KEY), RANKS[priority])
    ends = now + left if running else None
    return _Fit(fit_id, job_id, running, job, left, started, ends=ends)


def _play(
    fits: Sequence[_Fit],
    queued: dict[str, list[str]],
    workers: Sequence[frozenset[str]],
    turns: Turns,
    now: float,
    turn_seconds: float,
) -> list[_Fit]:
    """Play the queues through, and note starts and ends; return the fits in order of their starts.

    Those that are on no queue are about to be put on `fits`. Without workers one is supposed, for
    the order.
    """
    waiting = {fit.job_id: fit for fit in fits if not fit.running}
    lines: dict[str, _Line] = defaultdict(_Line)
    for name, job_ids in queued.items():
        for job_id in job_ids:
            if job_id in waiting:
                lines[name].add(waiting.pop(job_id))
    for fit in waiting.values():
        lines["fits"].add(fit)
    number = max([0.0, *turns.of_projects.values()])
    busy = sorted(fit.left for fit in fits if fit.running)
    free = [(now, place) for place in range(max(len(workers), 1))]
    for place, left in enumerate(busy[: len(free)]):
        free[place] = (now + left, place)
    heapq.heapify(free)
    started: list[_Fit] = []
    for _ in range(MOST_TURNS):
        if not free:
            break
        moment, place = heapq.heappop(free)
        names = sorted(workers[place] if workers else lines)
        heads = [(turns.place(fit.job), name, fit) for name in names for fit in lines[name].heads()]
        if not heads:
            continue
        (_, name, fit) = min(heads, key=lambda head: head[0])  # of equals the first
        lines[name].remove(fit)
        number += 1
        turns.of_projects[fit.job.who.project] = turns.of_keys[fit.job.who] = number
        if fit.starts is None:
            fit.starts = moment
            started.append(fit)
        gives_way = any(head.job.goes_before(fit.job) for head in lines[name].heads())
        took = min(fit.left, turn_seconds) if gives_way else fit.left
        fit.left -= took
        if fit.left > 0:
            lines[name].add(fit, at_front=True)
        else:
            fit.ends = moment + took
        heapq.heappush(free, (moment + took, place))
    return started
