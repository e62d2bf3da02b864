"""Signs of working workers: keys on the queue that expire by themselves.

RQ's heartbeat shows that a process lives. A sign here shows that a worker has updated the records
and has returned from looking for jobs, or that it runs one. No clocks are compared.
"""

from typing import NamedTuple

from redis import Redis
from rq import Worker

SIGN_SECONDS = 60  # for how long a sign holds; a worker leaves one every two seconds
_SIGN = "fewview:at-work:"
_STARTED = "fewview:worker-started"


class Workers(NamedTuple):
    """Workers of a queue's server.

    Attributes
    ----------
    known
        Those that live, or do so from time to time.
    at_work
        Those that do their work.
    """

    known: int
    at_work: int


def note_start(connection: Redis) -> None:
    """Leave a sign that a worker starts: one that never gets further is known all the same."""
    connection.set(_STARTED, b"", ex=SIGN_SECONDS)


def leave_sign(connection: Redis, worker: str) -> None:
    """Leave a sign that the worker with this key of RQ's does its work."""
    connection.set(_SIGN + worker, b"", ex=SIGN_SECONDS)


def is_at_work(connection: Redis, worker: str) -> bool:
    """Return whether the worker with this key of RQ is working."""
    return bool(connection.exists(_SIGN + worker))


def count(connection: Redis) -> Workers:
    """Count the workers on the queue."""
    names = Worker.all_keys(connection=connection)
    with connection.pipeline(transaction=False) as pipeline:
        for name in names:
            pipeline.exists(name)
            pipeline.exists(_SIGN + name)
        pipeline.exists(_STARTED)
        *found, started = pipeline.execute()
    return Workers(max(sum(found[::2]), started), sum(found[1::2]))
