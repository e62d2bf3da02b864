"""What fits and lifts have in common: work that is recorded here and carried by the queue.

A function that treats both alike takes the kind of record, :class:`store.records.FitRecord` or
:class:`store.records.LiftRecord`. What differs is in ``store.fits`` and ``store.lifts``.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar, get_args

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from store import audit, clock, webhooks
from store.authors import ALL_PROJECTS, Author, author_of
from store.database import Store
from store.disposal import condemn, discard
from store.errors import ConflictError, QueueFullError, ShareError
from store.idempotency import Idempotency, claim
from store.ids import new_id
from store.locks import alone
from store.lookup import get, lock
from store.records import AccessKey, FitRecord, LiftRecord
from store.shares import NO_KEY, Shares, Who, who_owns
from store.usage import check_queue

TERMINAL = ("succeeded", "failed", "cancelled")
MAX_CRASHES = 5  # workers that one fit, or one chunk of a lift, may take down

Priority = Literal["high", "normal", "low"]  # of a fit among those of its project
RANKS = {name: rank for rank, name in enumerate(get_args(Priority))}
RAISE_SECONDS = 24 * 3600.0  # a guess: who looks a day later shall not find that nothing was done

Job = TypeVar("Job", FitRecord, LiftRecord)
Make = Callable[[Session, str], Job]  # of a record, in this session, with this identifier


def create(
    store: Store,
    kind: type[Job],
    make: Make[Job],
    *,
    job_id: str | None,
    max_queued: int | None,
    idempotency: Idempotency | None,
) -> Job:
    """Record a queued job, or return the one that this request, or this queue job, made before.

    Raises
    ------
    QueueFullError
        If ``max_queued`` of its kind wait already.
    ShareError
        If the author's key or project has its share of them, and others may come.
    """
    identifier = new_id(kind.noun)
    with store.writing() as session:
        earlier = claim(session, idempotency, identifier)
        if earlier is None:
            alone(session, kind.__tablename__)  # so that none is made twice, or beyond the limit
        if earlier is None and job_id is not None:
            earlier = session.scalar(select(kind.id).where(kind.job_id == job_id))
        if earlier is None:
            if max_queued is not None:
                _check_waiting(session, kind, max_queued)
            check_queue(session)
            made = make(session, identifier)
            session.add(made)
            audit.note(session, f"{kind.noun}.create", identifier)
    return made if earlier is None else get(store, kind, earlier)


def _check_waiting(session: Session, kind: type[Job], most: int) -> None:
    """Raise unless one more job may wait: of all, and of the author's key and project."""
    grouped = (
        select(kind.project, kind.key_id, func.count(kind.id))
        .where(kind.status == "queued")
        .group_by(kind.project, kind.key_id)
    )
    shares = Shares(most)
    for project, key_id, count in session.execute(grouped, execution_options=ALL_PROJECTS):
        shares.take(Who(project, key_id or NO_KEY), count)
    if shares.free <= 0:
        raise QueueFullError(kind.noun, most)
    author = author_of(session) or Author()
    if not shares.may_take(Who(author.project, author.key_id)) and _others_may_come(session):
        raise ShareError(
            f"This key, or its project, has its share of the {most} {kind.noun}s that may wait: "
            "try again when some of its own have run."
        )


def _others_may_come(session: Session) -> bool:
    """Return whether any key is in force: if not, the user of the service is alone."""
    in_force = select(AccessKey.id).where(AccessKey.revoked_at.is_(None)).limit(1)
    return session.scalar(in_force) is not None


class Waiting(NamedTuple):
    """A job that waits.

    Attributes
    ----------
    who
        Whose it is.
    rank
        Of its priority, the most urgent first.
    """

    who: Who
    rank: int = RANKS["normal"]

    def goes_before(self, other: "Waiting") -> bool:
        """Return whether it may take the place of one that runs: others take turns with that."""
        if self.who.project != other.who.project:
            return True
        return self.rank < other.rank or (self.rank == other.rank and self.who != other.who)


def rank(priority: str, waited_seconds: float) -> int:
    """Return the rank of a fit: each day of waiting counts as the next priority."""
    return max(RANKS[priority] - max(int(waited_seconds // RAISE_SECONDS), 0), RANKS["high"])


def waiting(store: Store, *, running: str | None = None) -> dict[str, Waiting]:
    """Return the jobs that wait, or may be waiting, by their names on the queue.

    Parameters
    ----------
    running
        The job of a fit that is looked for, too, though it may run.
    """
    columns = (FitRecord.job_id, FitRecord.project, FitRecord.key_id, FitRecord.priority)
    wanted = (FitRecord.status == "queued") | (FitRecord.job_id == running)
    of_fits = select(*columns, clock.now() - FitRecord.created_at).where(wanted)
    active = select(LiftRecord).where(LiftRecord.status.in_(("queued", "running")))
    with store.reading() as session:
        found = {
            name: Waiting(Who(project, key_id or NO_KEY), rank(priority, waited))
            for name, project, key_id, priority, waited in session.execute(of_fits)
        }
        for lift in session.scalars(active):
            found[waiting_job(lift)] = Waiting(who_owns(lift))
    return found


def waiting_job(lift: LiftRecord) -> str:
    """Return the identifier of the queue job that calls the next helper.

    The first is the job that asked for the lift; each that starts makes the next.
    """
    return lift.job_id if lift.helpers == 0 else f"{lift.id}-{lift.helpers}"


def refuse(
    store: Store, kind: type[Job], *, job_id: str, error: dict[str, Any], **columns: Any
) -> str:
    """Record a job that can never run, so that its producer can read why; return its id.

    Parameters
    ----------
    columns
        The fields of the job.
    """
    with store.writing() as session:
        alone(session, kind.__tablename__)
        known = session.scalar(select(kind.id).where(kind.job_id == job_id))
        if known is not None:
            return known
        now = clock.read(session)
        refused = kind(
            id=new_id(kind.noun),
            job_id=job_id,
            status="failed",
            created_at=now,
            finished_at=now,
            error=error,
            frames=0,
            **columns,
        )
        session.add(refused)
        session.flush()  # which fills in its project
        webhooks.announce(session, refused)
    return refused.id


def by_job(store: Store, kind: type[Job], job_id: str) -> Job | None:
    """Return the record of this kind that a queue job asked for, or None."""
    with store.reading() as session:
        return session.scalar(select(kind).where(kind.job_id == job_id))


def lock_to_cancel(session: Session, kind: type[Job], identifier: str) -> Job:
    """Return a job that may be cancelled, or is already.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If it has ended otherwise.
    """
    job = lock(session, kind, identifier)
    if job.status in ("succeeded", "failed"):
        raise ConflictError(
            f"{kind.noun.capitalize()} {identifier!r} has already {job.status}; it cannot be "
            "cancelled."
        )
    asked_before = isinstance(job, FitRecord) and job.cancel_requested_at is not None
    if job.status != "cancelled" and not asked_before:
        audit.note(session, f"{kind.noun}.cancel", identifier)
    return job


def delete(
    store: Store, kind: type[Job], identifier: str, forget: Callable[[Session, Job], list[str]]
) -> None:
    """Delete a job that has ended, and its objects.

    Parameters
    ----------
    forget
        Removes other records of the job, and returns the keys of its objects.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If it is queued or running.
    """
    with store.writing() as session:
        job = lock(session, kind, identifier)
        if job.status not in TERMINAL:
            raise ConflictError(
                f"{kind.noun.capitalize()} {identifier!r} is {job.status}: cancel it first."
            )
        keys = condemn(session, forget(session, job))
        session.delete(job)
        audit.note(session, f"{kind.noun}.delete", identifier)
    discard(store, *keys)


def refuse_if_used(
    session: Session, what: str, identifier: str, kind: type[Job], *uses: ColumnElement[bool]
) -> None:
    """Raise ``ConflictError`` if a job that has not ended uses something, which is locked.

    Parameters
    ----------
    what, identifier
        What is to be deleted, for the message.
    kind, uses
        Jobs of this kind use it of which all these conditions hold.
    """
    query = select(kind.id).where(*uses, kind.status.not_in(TERMINAL)).limit(5)
    busy = session.scalars(query).all()
    if busy:
        raise ConflictError(
            f"{what} {identifier!r} is in use by {', '.join(busy)}: cancel these "
            f"{kind.noun}s or wait for them to end."
        )
