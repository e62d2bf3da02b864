"""What fits and lifts have in common: work that is queued, followed, cancelled and deleted."""

from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any, Literal, NamedTuple

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response, status
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel
from redis import Redis
from typing_extensions import TypeAliasType

from service.http.dependencies import RedisDep, StoreDep
from service.http.errors import problems
from service.http.keyring import still_let_in
from service.http.operations import UNCHANGED
from service.http.preconditions import tagged
from service.resources.changes import Change, add_change_route
from service.resources.events import EventsDep
from service.resources.lists import Columns
from store import jobs, lookup
from store.database import Store
from store.jobs import Job
from worker.queue import offer

JobStatus = TypeAliasType(
    "JobStatus", Literal["queued", "running", "succeeded", "failed", "cancelled"]
)
LastEventId = Annotated[
    int | None, Header(description="The last event you have; only newer ones are sent.")
]


class Words(NamedTuple):
    """The texts of the OpenAPI document on one kind of job."""

    delete: str
    cancel: str
    progress: str  # when an event of this name is sent


def finder(kind: type[Job]) -> Callable[[str, Store], Job]:
    """Return the dependency that finds the job named in the path, or ends in 404."""

    def find(
        identifier: Annotated[str, Path(alias=f"{kind.noun}_id", max_length=200)], store: StoreDep
    ) -> Job:
        return lookup.get(store, kind, identifier)

    return find


async def job_columns(
    status: Annotated[JobStatus | None, Query()] = None,
    dataset_id: Annotated[str | None, Query(max_length=200)] = None,
    job_id: Annotated[
        str | None, Query(max_length=200, description="Shows that of a job you queued yourself.")
    ] = None,
) -> Columns:
    """Return what columns of the jobs in a list must hold."""
    return {"status": status, "dataset_id": dataset_id, "job_id": job_id}


def announce(job: Any, store: Store, redis: Redis, response: Response) -> None:
    """Put a job that was just recorded on its queue, and return its location."""
    if job.status == "queued":
        offer(redis, store, job)
    response.headers["Location"] = _url(job)


def add_job_routes(
    router: APIRouter,
    kind: type[Job],
    form: type[BaseModel],
    to_wire: Callable[[Job], BaseModel],
    *,
    cancel: Callable[[Store, Redis, str], Job],
    delete: Callable[[Store, str], None],
    words: Words,
    change: type[Change] = Change,
) -> None:
    """Add the operations on one job: describe, change, delete, cancel, follow.

    Parameters
    ----------
    form, to_wire
        The JSON form of a job, and the function that makes it from a record.
    cancel, delete
        Functions that do so, and raise as those of ``store.jobs``.
    change
        The JSON form of what can be changed.
    """
    noun = kind.noun
    path = f"/{{{noun}_id}}"
    found = Depends(finder(kind))

    @router.get(
        path,
        name=f"get_{noun}",
        response_model=form,
        description=f"Describe a {noun} and its progress.",
        responses=problems("not_found") | UNCHANGED,
    )
    def get_job(job: Annotated[Job, found], request: Request, response: Response) -> Any:
        return tagged(request, response, job, to_wire)

    add_change_route(router, kind, form, to_wire, change=change)

    @router.delete(
        path,
        name=f"delete_{noun}",
        status_code=status.HTTP_204_NO_CONTENT,
        description=words.delete,
        responses=problems("origin_not_allowed", "not_found", "conflict"),
    )
    def delete_job(job: Annotated[Job, found], store: StoreDep) -> None:
        delete(store, job.id)

    @router.post(
        f"{path}/cancel",
        name=f"cancel_{noun}",
        status_code=status.HTTP_202_ACCEPTED,
        response_model=form,
        description=words.cancel,
        responses=problems("not_found", "conflict"),
    )
    def cancel_job(
        job: Annotated[Job, found], store: StoreDep, redis: RedisDep, response: Response
    ) -> Any:
        cancelled = cancel(store, redis, job.id)
        response.headers["Location"] = _url(cancelled)
        return to_wire(cancelled)

    _add_events_route(router, kind, to_wire, words.progress)


def _add_events_route(
    router: APIRouter,
    kind: type[Job],
    to_wire: Callable[[Job], BaseModel],
    progress: str,
) -> None:
    noun = kind.noun

    @router.get(
        f"/{{{noun}_id}}/events",
        name=f"stream_{noun}_events",
        response_class=EventSourceResponse,
        description=f"Follow a {noun}: server-sent events `progress` {progress}, then one "
        f"`end`.\n\nThe data of every event is the {noun} as `GET /{noun}s/{{{noun}_id}}` gives "
        "it, its id grows with every\nchange. Close the stream on `end`. Where it ends without "
        "one, the service stopped, the job was\ndeleted or the key is no longer in force: ask "
        "again with `Last-Event-ID`, and the answer names\nthe reason.",
        responses=problems("not_found", "draining"),
    )
    async def stream_job_events(
        events: EventsDep,
        job: Annotated[Job, Depends(finder(kind))],
        request: Request,
        last_event_id: LastEventId = None,
    ) -> AsyncIterator[ServerSentEvent]:
        async for current in events.follow(job, last_event_id or 0, still_let_in(request)):
            yield ServerSentEvent(
                data=to_wire(current),
                event="end" if current.status in jobs.TERMINAL else "progress",
                id=str(current.revision),
            )


def _url(job: Any) -> str:
    return f"/{job.noun}s/{job.id}"
