"""Who follows a job hears of its changes: one look at the records, at a time, for all of them."""

import asyncio
import logging
from collections import defaultdict
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Depends, Request
from sqlalchemy import select

from service.http.dependencies import refuse_if_leaving
from service.http.places import Places
from store import jobs
from store.database import Store
from store.jobs import Job

logger = logging.getLogger(__name__)

LOOK_SECONDS = 0.25  # between two looks
ALL_FOLLOWED = (
    "As many jobs are followed as may be; try again when some have ended, or ask for the job "
    "itself now and then."
)


@dataclass(eq=False)
class _Follower:
    """Somebody who waits until a job has another revision than the one he has."""

    kind: type[Any]
    job_id: str
    seen: int
    may_follow: Callable[[], bool]
    newer: "asyncio.Future[Any]"


class Events:
    """The followers of one process. The records are read only while there are any."""

    def __init__(self, store: Store, leaving: asyncio.Event) -> None:
        self._store, self._leaving = store, leaving
        self._followers: set[_Follower] = set()
        self._looking: asyncio.Task[None] | None = None

    async def follow(
        self, job: Job, seen: int, may_follow: Callable[[], bool] = lambda: True
    ) -> AsyncIterator[Job]:
        """Yield the record of a job as it is and with every change, until it has ended.

        It also ends when the job is deleted, when this process shuts down (clients then ask
        another) and when the follower's key is no longer valid.

        Parameters
        ----------
        seen
            The revision that the follower has, 0 for none.
        may_follow
            Returns whether the follower's key is still valid; called with every look.
        """
        current: Job | None = job
        while current is not None:
            ended = current.status in jobs.TERMINAL
            if ended or current.revision > seen:
                seen = current.revision
                yield current
            if ended or self._leaving.is_set():
                return
            current = await self._newer(type(job), job.id, seen, may_follow)

    async def _newer(
        self, kind: type[Any], job_id: str, seen: int, may_follow: Callable[[], bool]
    ) -> Any:
        """Return the record once it is newer than ``seen``; None if there will be none."""
        newer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        follower = _Follower(kind, job_id, seen, may_follow, newer)
        self._followers.add(follower)
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._look())
        try:
            return await newer
        finally:
            self._followers.discard(follower)

    async def _look(self) -> None:
        """Look at the records while anybody follows; an outage of theirs is waited out."""
        blind = False
        while self._followers:
            await asyncio.sleep(LOOK_SECONDS)
            waiting = [follower for follower in self._followers if not follower.newer.done()]
            for follower in waiting:
                if not follower.may_follow():
                    follower.newer.set_result(None)
            found: dict[tuple[type[Any], str], Any] = {}
            try:
                if not self._leaving.is_set():
                    found = await asyncio.to_thread(self._read, waiting)
                blind = False
            except Exception:  # those who follow go on waiting
                if not blind:
                    logger.exception("The records of jobs cannot be read: their followers wait")
                blind = True
                continue
            for follower in waiting:
                job = found.get((follower.kind, follower.job_id))
                changed = job is None or job.revision > follower.seen
                if changed and not follower.newer.done():
                    follower.newer.set_result(job)

    def _read(self, waiting: list[_Follower]) -> dict[tuple[type[Any], str], Any]:
        """Return the records that are followed, those that are left."""
        wanted: dict[type[Any], set[str]] = defaultdict(set)
        for follower in waiting:
            wanted[follower.kind].add(follower.job_id)
        with self._store.reading() as session:
            return {
                (kind, job.id): job
                for kind, ids in wanted.items()
                for job in session.scalars(select(kind).where(kind.id.in_(ids)))
            }


async def take_place(request: Request) -> AsyncIterator[Events]:
    """Give the source of changes to one of a limited number of followers.

    Raises
    ------
    ApiError
        429 if the key or its project has its share of them, 503 if there are too many in all, or
        if this process shuts down.
    """
    refuse_if_leaving(request)
    places: Places = request.app.state.event_places
    refusal = places.refusal(request, ALL_FOLLOWED)
    if refusal is not None:
        raise refusal
    with places.held(request):
        yield request.app.state.events


EventsDep = Annotated[Events, Depends(take_place)]
