"""Whose job is next: projects take turns at the workers, and of a project its keys.

The queues are lists, whose first job a worker takes. Before it does, it brings the job to the front
whose turn it is: of the project that has waited longest since its last job began, of its most
urgent ones, of the key that has waited longest, the first. Redis numbers the turns, so no clocks
are compared.
"""

import heapq
import logging
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, TypeVar

from redis import Redis
from rq import Queue

from store import jobs
from store.database import Store
from store.jobs import Waiting
from store.shares import Who
from worker.queue import WorkQueue

logger = logging.getLogger(__name__)

TURN = "fewview:turn"  # the number of the last turn
LAST_TURNS = "fewview:last-turns"  # of each project, and of each key
MOST_KNOWN = 10_000  # projects and keys whose last turns are kept

Lane = tuple[int, str]  # a rank and a key
Name = TypeVar("Name", str, Lane)
Turns = dict[str, float]  # the numbers of the last turns of projects and keys


class _Order(Generic[Name]):
    """Names by a rank that may grow at any time; of equals the one with the first place."""

    def __init__(self, rank: Callable[[Name], Any]) -> None:
        self._rank: Callable[[Name], Any] = rank
        self._heap: list[tuple[Any, int, Name]] = []

    def add(self, name: Name, place: int) -> None:
        heapq.heappush(self._heap, (self._rank(name), place, name))

    def first(self, waits: Callable[[Name], bool]) -> Name | None:
        """Return the first that waits; those before it are forgotten until they come again."""
        while self._heap:
            known, place, name = self._heap[0]
            if not waits(name):
                heapq.heappop(self._heap)
            elif (rank := self._rank(name)) != known:
                heapq.heapreplace(self._heap, (rank, place, name))
            else:
                return name
        return None


class _Project:
    """Jobs of one project that wait on one queue."""

    def __init__(self, name: str, turns: Turns) -> None:
        self._lanes: dict[Lane, deque[str]] = {}
        self._order: _Order[Lane] = _Order(
            lambda lane: (lane[0], turns.get(_name(Who(name, lane[1])), 0.0))
        )

    def lane(self, job: Waiting, place: int) -> deque[str]:
        """Return where jobs of a rank and a key wait."""
        name = job.rank, job.who.key_id
        lane = self._lanes.setdefault(name, deque())
        if not lane:
            self._order.add(name, place)
        return lane

    def first(self) -> Lane | None:
        """Return the lane whose turn it is."""
        return self._order.first(lambda lane: bool(self._lanes[lane]))

    def take(self) -> str:
        lane = self.first()
        assert lane is not None  # noqa: S101 (it is asked of projects with jobs)
        return self._lanes[lane].popleft()


class Line:
    """Jobs that wait on one queue, to be taken in fair turns."""

    def __init__(self, waiting: Iterable[tuple[str, Waiting]], turns: Turns) -> None:
        """Line up jobs, which come in the order of the queue.

        Parameters
        ----------
        turns
            Who takes jobs from this line, or others, notes the turns in it.
        """
        self._turns = turns
        self._projects: dict[str, _Project] = {}
        self._order: _Order[str] = _Order(lambda project: turns.get(project, 0.0))
        for place, (job_id, job) in enumerate(waiting):
            self._lane(job, place).append(job_id)

    def take(self) -> str | None:
        """Take the job whose turn it is; None if there is none."""
        name = self._order.first(self._projects.__contains__)
        if name is None:
            return None
        project = self._projects[name]
        taken = project.take()
        if project.first() is None:
            del self._projects[name]
        return taken

    def put_back(self, job_id: str, job: Waiting) -> None:
        """Put a job that has ended its turn before the others of its rank and key."""
        self._lane(job, -1).appendleft(job_id)

    def gives_way(self, job: Waiting) -> bool:
        """Return whether another job waits that goes on before one that has just had its turn."""
        mine = job.who.project
        if any(project != mine for project in self._projects):
            return True
        first = self._projects[mine].first() if mine in self._projects else None
        return first is not None and Waiting(Who(mine, first[1]), first[0]).goes_before(job)

    def _lane(self, job: Waiting, place: int) -> deque[str]:
        name = job.who.project
        if name not in self._projects:
            self._projects[name] = _Project(name, self._turns)
            self._order.add(name, place)
        return self._projects[name].lane(job, place)


def bring_forward(store: Store, queues: Iterable[Queue]) -> None:
    """Put the job whose turn it is at the front of each queue where several wait."""
    several = [queue for queue in queues if queue.count > 1]
    if not several:
        return
    waiting = jobs.waiting(store)
    for queue in several:
        line = [(job_id, waiting[job_id]) for job_id in queue.get_job_ids() if job_id in waiting]
        owners = {job for _, job in line}
        if len(owners) < 2:
            continue
        first = Line(line, last_turns(queue.connection, {job.who for job in owners})).take()
        if first is not None and first != line[0][0]:
            _put_first(queue, first)


def note_turn(store: Store, connection: Redis, job_id: str) -> None:
    """Note that a job is taken by a worker: its project, and its key, have had their turn."""
    job = jobs.waiting(store).get(job_id)
    if job is None:  # it was done already, or by another job
        return
    number = connection.incr(TURN)
    connection.zadd(LAST_TURNS, dict.fromkeys(names(job.who), number))
    connection.zremrangebyrank(LAST_TURNS, 0, -MOST_KNOWN - 1)


def others_wait(store: Store, queues: Sequence[WorkQueue], job_id: str) -> set[str]:
    """Return the jobs on queues that go on before a fit that runs, whose turn is over."""
    known = jobs.waiting(store, running=job_id)
    mine = known.get(job_id)
    if mine is None:  # it was deleted
        return set()
    waiting = {name for queue in queues for name in queue.get_job_ids()} - {job_id}
    return {name for name in waiting if name in known and known[name].goes_before(mine)}


def last_turns(connection: Redis, owners: Iterable[Who]) -> Turns:
    """Return the numbers of the last turns of projects and of their keys."""
    asked = sorted({name for owner in owners for name in names(owner)})
    scores = connection.zmscore(LAST_TURNS, asked) if asked else []
    return {name: score or 0.0 for name, score in zip(asked, scores, strict=True)}


def names(who: Who) -> tuple[str, str]:
    """Return the names under which the turns of a project and of its key are known."""
    return who.project, _name(who)


def _name(who: Who) -> str:
    return f"{who.project}/{who.key_id}"


def _put_first(queue: Queue, job_id: str) -> None:
    with queue.connection.pipeline() as commands:
        commands.lrem(queue.key, 1, job_id)
        commands.lpush(queue.key, job_id)
        removed, _ = commands.execute()
    if not removed:  # another worker has taken it meanwhile
        queue.connection.lrem(queue.key, 1, job_id)
