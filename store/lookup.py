"""What has an identifier, datasets, models, fits and lifts alike: reading and renaming it."""

from collections.abc import Mapping
from typing import Any, TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from store.database import Store
from store.errors import NotFoundError
from store.records import Dataset, FitJob, Job, LiftJob, Model

HALF_A_MICROSECOND = 0.5e-6

Resource = TypeVar("Resource", Dataset, Model, FitJob, LiftJob)


def get(store: Store, kind: type[Resource], identifier: str) -> Resource:
    """Return the record of this kind with this identifier; ``NotFoundError`` if there is none."""
    with store.reading() as session:
        return _found(session.get(kind, identifier), kind, identifier)


def lock(session: Session, kind: type[Resource], identifier: str) -> Resource:
    """Do the same in a transaction that writes; nobody else changes the record until its end."""
    return _found(session.get(kind, identifier, with_for_update=True), kind, identifier)


def change(
    store: Store, kind: type[Resource], identifier: str, columns: Mapping[str, Any]
) -> Resource:
    """Have columns of a record hold something else, and return it; ``NotFoundError`` as above."""
    with store.writing() as session:
        record = lock(session, kind, identifier)
        for name, value in columns.items():
            setattr(record, name, value)
        if isinstance(record, Job) and columns:
            record.revision += 1
    return record


def page(
    store: Store,
    kind: type[Resource],
    *,
    limit: int,
    after: str | None,
    created_before: float | None = None,
    created_after: float | None = None,
    **equal: str | None,
) -> list[Resource]:
    """Return up to ``limit`` records, newest first, older than ``after`` if it is given.

    Parameters
    ----------
    created_before, created_after
        Seconds since the epoch, compared as they travel, in microseconds.
    equal
        What columns must hold; None allows anything.
    """
    query = select(kind).order_by(kind.id.desc()).limit(limit)
    if after is not None:
        query = query.where(kind.id < after)
    if created_before is not None:
        query = query.where(kind.created_at < created_before - HALF_A_MICROSECOND)
    if created_after is not None:
        query = query.where(kind.created_at > created_after + HALF_A_MICROSECOND)
    query = query.filter_by(**{name: value for name, value in equal.items() if value is not None})
    with store.reading() as session:
        return list(session.scalars(query))


def _found(record: Resource | None, kind: type[Resource], identifier: str) -> Resource:
    if record is None:
        raise NotFoundError(kind.noun, identifier)
    return record
