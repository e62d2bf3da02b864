"""When fits are expected to start and to end.

The order of the queues (`worker.fair_order`) is played through with the workers there are, and with
durations of fits that were made (`worker.durations`). Lifts are left out, for they give way, and so
is what comes later.
"""

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from redis import Redis
from rq import Worker
from sqlalchemy import Select, select

from store import clock
from store.database import Store
from store.jobs import Waiting, rank
from store.records import DatasetRecord, FitRecord
from store.shares import NO_KEY, Who
from worker import at_work
from worker.durations import MEASURED, Durations, Size
from worker.fair_order import Line, Turns, last_turns, names
from worker.queue import open_queues

MOST_EVENTS = 50_000  # that are played through
HANDOVER_SECONDS = 1.0  # from one fit of a worker to its next: `python -m benchmarks.turns`


class Forecast(NamedTuple):
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
    priority
        Of the fit, as this was expected.
    """

    ahead: int
    start: float | None
    end: float | None
    workers: int
    measured: int
    priority: str


@dataclass
class _Fit:
    """A fit that has not ended, as it is played through."""

    id: str
    job_id: str
    running: bool
    job: Waiting
    priority: str
    left: float  # seconds
    turn: float  # seconds that are left of its turn
    known: bool  # how long it takes
    started: float | None
    queue: str = "fits"
    place: int = 0  # among the starts
    starts: float | None = None
    ends: float | None = None


class _Worker(NamedTuple):
    """A worker that is there: the queues it takes from, and its job."""

    queues: tuple[str, ...]
    job_id: str | None


def schedules(store: Store, connection: Redis, turn_seconds: float) -> dict[str, Forecast]:
    """Return what is expected of all fits that wait or run.

    Parameters
    ----------
    turn_seconds
        How long a fit keeps its worker while others wait.
    """
    queued = {queue.name: queue.get_job_ids() for queue in open_queues(connection)}
    workers = [worker for worker in _workers(connection) if queued.keys() & set(worker.queues)]
    with store.reading() as session:
        now = clock.read(session)
        made = session.execute(_measured())
        durations = Durations((took, Size(*size)) for took, *size in made)
        rows = session.execute(_open()).all()
    fits = {row.job_id: _of_row(row, durations, now, turn_seconds) for row in rows}
    turns = last_turns(connection, {fit.job.who for fit in fits.values()})
    # Without workers one is supposed, for the order.
    supposed = workers or [_Worker(tuple(queued), None)]
    _Play(fits, queued, supposed, turns, turn_seconds).run(now)
    serving = {name: sum(name in worker.queues for worker in workers) for name in queued}
    return {fit.id: _expected(fit, serving[fit.queue], len(durations)) for fit in fits.values()}


def _expected(fit: _Fit, workers: int, measured: int) -> Forecast:
    known = fit.known and workers > 0
    start = fit.started if fit.started is not None else fit.starts if known else None
    waits = fit.started is None
    ends = fit.ends if known else None
    return Forecast(fit.place * waits, start, ends, workers, measured, fit.priority)


SIZE = (
    FitRecord.frames,
    DatasetRecord.views,
    DatasetRecord.keypoints,
    FitRecord.config["steps"].as_integer().label("steps"),
    FitRecord.config["batch_size"].as_integer().label("batch_size"),
)
IS_OF = DatasetRecord.id == FitRecord.dataset_id


def _measured() -> Select[Any]:
    return (
        select(FitRecord.finished_at - FitRecord.started_at, *SIZE)
        .join(DatasetRecord, IS_OF)
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
            FitRecord.created_at,
            FitRecord.progress,
            FitRecord.started_at,
            FitRecord.attempt,
            *SIZE,
        )
        .outerjoin(DatasetRecord, IS_OF)
        .where(FitRecord.status.in_(("queued", "running")))
        .order_by(FitRecord.id)
    )


def _workers(connection: Redis) -> list[_Worker]:
    """Return the workers that do their work."""
    keys = Worker.all_keys(connection=connection)
    with connection.pipeline(transaction=False) as pipeline:
        for key in keys:
            pipeline.hmget(key, "queues", "current_job")
        held = [[text and text.decode() for text in each] for each in pipeline.execute()]
    return [
        _Worker(tuple((queues or "").split(",")), job_id)
        for key, (queues, job_id) in zip(keys, held, strict=True)
        if at_work.is_at_work(connection, key)
    ]


def _of_row(row: Any, durations: Durations, now: float, turn_seconds: float) -> _Fit:
    size = Size(row.frames, row.views, row.keypoints, row.steps, row.batch_size)
    usual = None if None in size[:4] else durations.usual(size)
    running, progress = row.status == "running", row.progress or {}
    left = progress.get("seconds_left") if running else None
    known = usual is not None or left is not None
    since = now - row.started_at if running and row.attempt == 1 else 0.0
    if left is None:
        done = progress.get("step", 0) / max(progress.get("steps", 1), 1)
        left = (usual or 1.0) * (1 - done) - (0.0 if progress else since)
    return _Fit(
        id=row.id,
        job_id=row.job_id,
        running=running,
        job=Waiting(
            Who(row.project, row.key_id or NO_KEY), rank(row.priority, now - row.created_at)
        ),
        priority=row.priority,
        left=max(left, 0.0),
        turn=max(turn_seconds - since, 0.0),
        known=known,
        started=row.started_at,
    )


class _Play:
    """The queues as they are, and what becomes of them if nothing else comes."""

    def __init__(
        self,
        fits: Mapping[str, _Fit],
        queued: Mapping[str, Sequence[str]],
        workers: Sequence[_Worker],
        turns: Turns,
        turn_seconds: float,
    ) -> None:
        """Line up the fits that wait; those that are on no queue are about to be put on `fits`."""
        self._fits, self._turns, self._turn_seconds = fits, turns, turn_seconds
        self._queues = [
            deque(name for name in worker.queues if name in queued) for worker in workers
        ]
        self._at_hand = [fits.get(worker.job_id or "") for worker in workers]
        begun = {fit.job_id for fit in self._at_hand if fit is not None}
        running = deque(fit for fit in fits.values() if fit.running and fit.job_id not in begun)
        for place, worker in enumerate(workers):
            if worker.job_id is None and running:  # it has just begun
                self._at_hand[place] = running.popleft()
        waits = {name: fit for name, fit in fits.items() if not fit.running and name not in begun}
        lines = {name: [job for job in job_ids if job in waits] for name, job_ids in queued.items()}
        for name, job_ids in lines.items():
            for job_id in job_ids:
                fits[job_id].queue = name
        placed = {job_id for job_ids in lines.values() for job_id in job_ids}
        lines["fits"] += [job_id for job_id in waits if job_id not in placed]
        self._lines = {
            name: Line(((job_id, waits[job_id].job) for job_id in job_ids), turns)
            for name, job_ids in lines.items()
        }
        self._number = max([0.0, *turns.values()])
        self._started = 0
        self._events: list[tuple[float, int, _Fit | None]] = []

    def run(self, now: float) -> None:
        """Note starts and ends in the fits."""
        for place, fit in enumerate(self._at_hand):
            self._go_on(now, place, fit)
        for _ in range(MOST_EVENTS):
            if not self._events:
                break
            moment, place, fit = heapq.heappop(self._events)
            if fit is None:
                taken = self._take(place)
                if taken is not None:
                    self._go_on(moment, place, taken)
            elif self._keeps_its_worker(moment, place, fit):
                self._go_on(moment, place, fit)
            else:
                self._go_on(moment + HANDOVER_SECONDS, place, None)
        for fit in self._fits.values():
            if fit.starts is None:
                fit.place = self._started

    def _go_on(self, moment: float, place: int, fit: _Fit | None) -> None:
        """Have a worker do a fit until this has ended, or its turn is over."""
        took = 0.0
        if fit is not None:
            if fit.starts is None and not fit.running:
                fit.starts, fit.place = moment, self._started
                self._started += 1
            took = min(fit.left, fit.turn)
            fit.left -= took
        heapq.heappush(self._events, (moment + took, place, fit))

    def _keeps_its_worker(self, moment: float, place: int, fit: _Fit) -> bool:
        """Return whether a fit goes on; one that has ended its turn may have to wait again."""
        if fit.left <= 0:
            fit.ends = moment
            return False
        fit.turn = self._turn_seconds
        if not any(self._lines[name].gives_way(fit.job) for name in self._queues[place]):
            return True
        self._lines[fit.queue].put_back(fit.job_id, fit.job)
        return False

    def _take(self, place: int) -> _Fit | None:
        """Return the fit whose turn it is at a worker, which takes from its queues in turn."""
        queues = self._queues[place]
        for _ in range(len(queues)):
            job_id = self._lines[queues[0]].take()
            queues.rotate(-1)
            if job_id is not None:
                fit = self._fits[job_id]
                self._number += 1
                self._turns.update(dict.fromkeys(names(fit.job.who), self._number))
                return fit
        return None
