"""Following a job as it goes on: server-sent events made from its record."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Literal, TypeVar

from fastapi import Header
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import ServerSentEvent
from pydantic import BaseModel

from store import jobs
from store.errors import NotFoundError
from store.records import Fit, Lift

POLL_SECONDS = 0.25

JobStatus = Literal["queued", "running", "succeeded", "failed", "cancelled"]
LastEventId = Annotated[
    int | None, Header(description="The last event you have; only newer ones are sent.")
]

Kind = TypeVar("Kind", Fit, Lift)


async def job_events(
    job: Kind,
    read: Callable[[], Kind],
    to_wire: Callable[[Kind], BaseModel],
    last_event_id: int | None,
) -> AsyncIterator[ServerSentEvent]:
    """Yield `progress` with every change of a job's record, then `end`.

    Parameters
    ----------
    job
        The record as it is now; ``read`` gives it as it is later.
    last_event_id
        The revision that the client has.
    """
    seen = last_event_id or 0
    while True:
        ended = job.status in jobs.TERMINAL
        if ended or job.revision > seen:
            seen = job.revision
            yield ServerSentEvent(
                data=to_wire(job), event="end" if ended else "progress", id=str(seen)
            )
        if ended:
            return
        await asyncio.sleep(POLL_SECONDS)
        try:
            job = await run_in_threadpool(read)
        except NotFoundError:  # it ended and was deleted since
            return
