"""The queues: what waits, for how long, and for whom."""

from datetime import UTC, datetime

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field
from rq import Worker

from service.http.dependencies import RedisDep
from service.http.errors import problems
from worker.queue import WorkQueue, open_queues
from worker.settings import QueueName

router = APIRouter(prefix="/queues", tags=["health"])


class WaitingJobs(BaseModel):
    """Jobs of one kind that no worker has taken yet."""

    queue: QueueName
    waiting: int = Field(description="Jobs on the queue.")
    oldest_seconds: float = Field(
        description="Time that the oldest of them has waited; 0 where none waits."
    )
    workers: int = Field(description="Workers that take from it, here or elsewhere, busy or not.")


class Queues(BaseModel):
    """All queues."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "items": [{"queue": "fits", "waiting": 3, "oldest_seconds": 41.7, "workers": 2}]
            }
        }
    )

    items: list[WaitingJobs]


@router.get("", responses=problems("unavailable"))
def list_queues(redis: RedisDep) -> Queues:
    """Return the jobs that wait for workers, for starting more or fewer of these."""
    return Queues(items=[_waiting(queue) for queue in open_queues(redis)])


def _waiting(queue: WorkQueue) -> WaitingJobs:
    oldest = next(iter(queue.get_jobs(0, 1)), None)
    since = None if oldest is None else oldest.enqueued_at
    waited = 0.0 if since is None else (datetime.now(UTC) - since).total_seconds()
    return WaitingJobs(
        queue=queue.name,
        waiting=queue.count,
        oldest_seconds=round(max(0.0, waited), 3),  # clocks of hosts differ
        workers=Worker.count(queue=queue),
    )
