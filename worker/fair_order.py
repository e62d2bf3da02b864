"""Whose job is next: projects take turns at the workers, and of a project its keys.

The queues are lists, whose first job a worker takes. Before it does, it brings the job to the front
whose turn it is: of the project that has waited longest since its last job began, of its most
urgent ones, of the key that has waited longest, the first. Redis numbers the turns, so no clocks
are compared.
"""

import logging
from collections.abc import Iterable, Sequence
from typing import NamedTuple

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


def bring_forward(store: Store, queues: Iterable[Queue]) -> None:
    """Put the job whose turn it is at the front of each queue where several wait."""
    several = [queue for queue in queues if queue.count > 1]
    if not several:
        return
    known = jobs.waiting(store)
    for queue in several:
        waiting = [job_id for job_id in queue.get_job_ids() if job_id in known]
        if len({known[job_id] for job_id in waiting}) < 2:
            continue
        turns = last_turns(queue.connection, [known[job_id].who for job_id in waiting])
        first = min(waiting, key=lambda job_id: turns.place(known[job_id]))  # of equals the first
        if first != waiting[0]:
            _put_first(queue, first)


def note_turn(store: Store, connection: Redis, job_id: str) -> None:
    """Note that a job is taken by a worker: its project, and its key, have had their turn."""
    job = jobs.waiting(store).get(job_id)
    if job is None:  # it was done already, or by another job
        return
    number = connection.incr(TURN)
    names = (job.who.project, _name(job.who))
    connection.zadd(LAST_TURNS, dict.fromkeys(names, number))
    connection.zremrangebyrank(LAST_TURNS, 0, -MOST_KNOWN - 1)


def others_wait(store: Store, queues: Sequence[WorkQueue], job_id: str, mine: Waiting) -> set[str]:
    """Return the jobs on queues that may take the place of one that runs."""
    known = jobs.waiting(store)
    waiting = {name for queue in queues for name in queue.get_job_ids()}
    return {name for name in waiting - {job_id} if known.get(name, mine).goes_before(mine)}


class Turns(NamedTuple):
    """Numbers of last turns; of projects that had none, -1 for the last that came, -2 and so on."""

    of_projects: dict[str, float]
    of_keys: dict[Who, float]

    def place(self, job: Waiting) -> tuple[float, int, float]:
        """Return the place of a job among those that wait: the least is next."""
        return self.of_projects[job.who.project], job.rank, self.of_keys[job.who]


def last_turns(connection: Redis, owners: Iterable[Who]) -> Turns:
    """Return the numbers of the last turns of owners, who are in the order of their jobs."""
    keys = list(dict.fromkeys(owners))
    projects = list(dict.fromkeys(owner.project for owner in keys))
    if not keys:
        return Turns({}, {})
    found = connection.zmscore(LAST_TURNS, [*projects, *map(_name, keys)])
    of_projects = {
        project: place - len(projects) if turn is None else turn
        for place, (project, turn) in enumerate(zip(projects, found, strict=False))
    }
    of_keys = dict(zip(keys, (turn or 0.0 for turn in found[len(projects) :]), strict=True))
    return Turns(of_projects, of_keys)


def _name(owner: Who) -> str:
    return f"{owner.project}/{owner.key_id}"


def _put_first(queue: Queue, job_id: str) -> None:
    with queue.connection.pipeline() as commands:
        commands.lrem(queue.key, 1, job_id)
        commands.lpush(queue.key, job_id)
        removed, _ = commands.execute()
    if not removed:  # another worker has taken it meanwhile
        queue.connection.lrem(queue.key, 1, job_id)
