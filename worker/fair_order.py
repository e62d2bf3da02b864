"""Whose job is next: projects take turns at the workers, and of a project its keys.

The queues are lists, whose first job a worker takes. Before it does, it brings the job to the front
whose turn it is: of the project that has waited longest since its last job began, of the key in it
that has, the first. Redis numbers the turns, so no clocks are compared.
"""

import logging
from collections.abc import Iterable, Sequence

from redis import Redis
from rq import Queue

from store import jobs
from store.database import Store
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
    owners = jobs.waiting(store)
    for queue in several:
        waiting = [job_id for job_id in queue.get_job_ids() if job_id in owners]
        if len({owners[job_id] for job_id in waiting}) < 2:
            continue
        turns = _last_turns(queue.connection, sorted({owners[job_id] for job_id in waiting}))
        first = min(waiting, key=lambda job_id: turns[owners[job_id]])  # of equals the first
        if first != waiting[0]:
            _put_first(queue, first)


def note_turn(store: Store, connection: Redis, job_id: str) -> None:
    """Note that a job is taken by a worker: its project, and its key, have had their turn."""
    owner = jobs.waiting(store).get(job_id)
    if owner is None:  # it was done already, or by another job
        return
    number = connection.incr(TURN)
    names = (owner.project, _name(owner))
    connection.zadd(LAST_TURNS, dict.fromkeys(names, number))
    connection.zremrangebyrank(LAST_TURNS, 0, -MOST_KNOWN - 1)


def others_wait(store: Store, queues: Sequence[WorkQueue], job_id: str, mine: Who) -> set[str]:
    """Return the jobs on queues that are of other projects or keys than a job that runs."""
    owners = jobs.waiting(store)
    waiting = {name for queue in queues for name in queue.get_job_ids()}
    return {name for name in waiting if name != job_id and owners.get(name, mine) != mine}


def _last_turns(connection: Redis, owners: Sequence[Who]) -> dict[Who, tuple[float, float]]:
    """Return the numbers of the last turns of owners: of their projects, and of their keys."""
    names = [name for owner in owners for name in (owner.project, _name(owner))]
    found = connection.zmscore(LAST_TURNS, names)
    scores = dict(zip(names, (score or 0.0 for score in found), strict=True))
    return {owner: (scores[owner.project], scores[_name(owner)]) for owner in owners}


def _name(owner: Who) -> str:
    return f"{owner.project}/{owner.key_id}"


def _put_first(queue: Queue, job_id: str) -> None:
    with queue.connection.pipeline() as commands:
        commands.lrem(queue.key, 1, job_id)
        commands.lpush(queue.key, job_id)
        removed, _ = commands.execute()
    if not removed:  # another worker has taken it meanwhile
        queue.connection.lrem(queue.key, 1, job_id)
