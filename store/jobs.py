"""What fits and lifts have in common: work that is recorded here and carried by the queue."""

import time
from collections.abc import Callable
from typing import Any, TypeVar

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from store.database import Store
from store.errors import ConflictError, NotFoundError, QueueFullError
from store.idempotency import Idempotency, remember, replayed
from store.ids import new_id
from store.records import Fit, Lift

TERMINAL = ("succeeded", "failed", "cancelled")
MAX_CRASHES = 5  # workers that one fit, or one chunk of a lift, may take down

Kind = TypeVar("Kind", Fit, Lift)
Make = Callable[[Session, str], Kind]  # of a record, in this session, with this identifier


def create(
    store: Store,
    kind: type[Kind],
    make: Make[Kind],
    *,
    job_id: str | None,
    max_queued: int | None,
    idempotency: Idempotency | None,
) -> Kind:
    """Record a queued job, or return the one that this request, or this queue job, made before.

    Raises
    ------
    QueueFullError
        If ``max_queued`` of its kind wait already.
    """
    identifier = new_id(_name(kind))
    with store.writing() as session:
        earlier = replayed(session, idempotency)
        if earlier is None and job_id is not None:
            earlier = session.scalar(select(kind.id).where(kind.job_id == job_id))
        if earlier is None:
            waiting = select(func.count()).select_from(kind).where(kind.status == "queued")
            if max_queued is not None and (session.scalar(waiting) or 0) >= max_queued:
                raise QueueFullError(_name(kind), max_queued)
            made = make(session, identifier)
            session.add(made)
            remember(session, idempotency, identifier)
    return made if earlier is None else get(store, kind, earlier)


def refuse(
    store: Store, kind: type[Kind], make: Make[Kind], *, job_id: str, error: dict[str, Any]
) -> str:
    """Record a job that can never run, so that whoever queued it can read why; return its id."""
    with store.writing() as session:
        known = session.scalar(select(kind.id).where(kind.job_id == job_id))
        if known is not None:
            return known
        refused = make(session, new_id(_name(kind)))
        refused.status, refused.error, refused.finished_at = "failed", error, refused.created_at
        session.add(refused)
    return refused.id


def new_columns() -> dict[str, Any]:
    """Return the columns of any job that is queued now."""
    return {"created_at": time.time(), "status": "queued", "revision": 1}


def get(store: Store, kind: type[Kind], identifier: str) -> Kind:
    """Return the record of a job; raise ``NotFoundError`` if there is none."""
    with store.reading() as session:
        found = session.get(kind, identifier)
    if found is None:
        raise NotFoundError(_name(kind), identifier)
    return found


def page(
    store: Store, kind: type[Kind], *, limit: int, after: str | None, **equal: str | None
) -> list[Kind]:
    """Return up to ``limit`` jobs, newest first, older than ``after`` if it is given.

    Parameters
    ----------
    equal
        What columns must hold; None allows anything.
    """
    query = select(kind).order_by(kind.id.desc()).limit(limit)
    if after is not None:
        query = query.where(kind.id < after)
    query = query.filter_by(**{name: value for name, value in equal.items() if value is not None})
    with store.reading() as session:
        return list(session.scalars(query))


def lock_to_cancel(session: Session, kind: type[Kind], identifier: str) -> Kind:
    """Return a job that may be cancelled, or is already.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If it has ended otherwise.
    """
    job = _lock(session, kind, identifier)
    if job.status in ("succeeded", "failed"):
        raise ConflictError(
            f"{kind.__name__} {identifier!r} has already {job.status}; it cannot be cancelled."
        )
    return job


def lock_to_delete(session: Session, kind: type[Kind], identifier: str) -> Kind:
    """Return a job that has ended.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If it is queued or running.
    """
    job = _lock(session, kind, identifier)
    if job.status not in TERMINAL:
        raise ConflictError(f"{kind.__name__} {identifier!r} is {job.status}: cancel it first.")
    return job


def refuse_if_used(session: Session, what: str, column: Any, identifier: str) -> None:
    """Raise ``ConflictError`` if a job that has not ended needs what ``column`` names.

    Parameters
    ----------
    what
        The kind of thing that is to be deleted, for the message.
    column
        ``Fit.dataset_id``, ``Lift.model_id``, ...
    """
    kind = column.class_
    busy = session.scalars(
        select(kind.id).where(column == identifier, kind.status.not_in(TERMINAL))
    ).all()
    if busy:
        raise ConflictError(
            f"{what} {identifier!r} is in use by {', '.join(busy[:5])}: cancel these "
            f"{_name(kind)}s or wait for them to end."
        )


def _lock(session: Session, kind: type[Kind], identifier: str) -> Kind:
    job = session.get(kind, identifier, with_for_update=True)
    if job is None:
        raise NotFoundError(_name(kind), identifier)
    return job


def _name(kind: type[Kind]) -> str:
    return kind.__name__.lower()
