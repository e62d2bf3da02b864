"""What has an identifier, datasets, models, fits and lifts alike: reading and renaming it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, defer

from store import audit
from store.account import RECORD_BYTES
from store.array_files import GetRange
from store.authors import author_of
from store.database import Store
from store.errors import ConflictError, DamagedError, NotFoundError, StoreError
from store.expectations import compare
from store.labels import mentions, says, tagged
from store.records import (
    DEFAULT_PROJECT,
    DatasetRecord,
    FitRecord,
    Job,
    LiftRecord,
    ModelAlias,
    ModelRecord,
)

HALF_A_MICROSECOND = 0.5e-6

Resource = TypeVar("Resource", DatasetRecord, ModelRecord, FitRecord, LiftRecord)


class Filters(NamedTuple):
    """The conditions on records; None or empty allows anything.

    Attributes
    ----------
    ids
        One of these identifiers.
    created_before, created_after
        Seconds since the epoch, compared as they travel, in microseconds.
    tags
        All of these.
    metadata
        These texts under these keys, as :func:`store.labels.says` compares them.
    equal
        Required values of columns.
    words
        Each in the name or in a tag, as :func:`store.labels.mentions` looks for it.
    """

    ids: Sequence[str] = ()
    created_before: float | None = None
    created_after: float | None = None
    tags: Sequence[str] = ()
    metadata: Mapping[str, str] = {}
    equal: Mapping[str, str | None] = {}
    words: Sequence[str] = ()

    def __bool__(self) -> bool:
        """Return whether there is any condition."""
        moments = (self.created_before, self.created_after)
        return any((self.ids, self.tags, self.metadata, self.words)) or any(
            value is not None for value in (*moments, *self.equal.values())
        )


def get(store: Store, kind: type[Resource], identifier: str) -> Resource:
    """Return the record of this kind with this identifier; ``NotFoundError`` if there is none."""
    with store.reading() as session:
        known = resolved(session, kind, identifier)
        return _found(session.get(kind, known), kind, identifier)


def is_alias(identifier: str) -> bool:
    """Return whether a name is an alias of a model rather than an identifier."""
    return "@" in identifier


def resolved(
    session: Session, kind: type[Resource], identifier: str, project: str | None = None
) -> str:
    """Return the model's identifier for an alias; any other identifier as it is.

    Parameters
    ----------
    project
        Whose alias; None: that of the session's author.

    Raises
    ------
    NotFoundError
        If there is no such alias.
    """
    if kind is not ModelRecord or not is_alias(identifier):
        return identifier
    author = author_of(session)
    whose = project or (DEFAULT_PROJECT if author is None else author.project)
    alias = session.get(ModelAlias, (whose, identifier))
    if alias is None:
        raise NotFoundError(kind.noun, identifier)
    return alias.model_id


def lost(
    store: Store, kind: type[Resource], identifier: str, missing: FileNotFoundError
) -> StoreError:
    """Return the error of an object that is not there: its record was deleted, has gone on, or not.

    A fit that goes on exchanges its first answer for another, and deletes it.
    """
    key = str(missing.filename)
    with store.reading() as session:
        record = session.get(kind, identifier)
        if record is None:
            return NotFoundError(kind.noun, identifier)
        if isinstance(record, FitRecord) and key not in _objects_of(record):
            return ConflictError(
                f"Fit {identifier!r} has gone on and has another answer by now, or none: ask again."
            )
    return DamagedError(key)


def _objects_of(fit: FitRecord) -> tuple[str | None, ...]:
    return fit.reconstruction_key, fit.report_key, fit.first_key, fit.first_model_key


def reader_of(store: Store, kind: type[Resource], identifier: str) -> GetRange:
    """Return a reader of ranges of a record's objects, which raises `lost` for missing ones."""

    def read(key: str, start: int, end: int) -> bytes:
        try:
            return store.objects.get_range(key, start, end)
        except FileNotFoundError as error:
            raise lost(store, kind, identifier, error) from error

    return read


def lock(
    session: Session, kind: type[Resource], identifier: str, project: str | None = None
) -> Resource:
    """Return a record in a transaction that writes; it is locked until its end.

    Raises ``NotFoundError`` if there is none, and what `store.expectations` does if it is not what
    the author expects; ``project`` is as :func:`resolved` takes it.
    """
    known = resolved(session, kind, identifier, project)
    record = _found(session.get(kind, known, with_for_update=True), kind, identifier)
    compare(session, kind, identifier, record)
    return record


def change(
    store: Store, kind: type[Resource], identifier: str, columns: Mapping[str, Any]
) -> Resource:
    """Have columns of a record hold something else, and return it; raise as `lock` does."""
    with store.writing() as session:
        record = lock(session, kind, identifier)
        put(session, record, columns)
    return record


def put(session: Session, record: Resource, columns: Mapping[str, Any]) -> None:
    """Have columns of a locked record hold something else, and note it in the audit.

    Nothing is changed, or noted, where they hold that already.
    """
    new = {name: value for name, value in columns.items() if getattr(record, name) != value}
    if not new:
        return
    before = _kept(session, record)
    for name, value in new.items():
        setattr(record, name, value)
    if isinstance(record, Job):
        record.revision += 1
    session.flush()
    freeing = _kept(session, record) + RECORD_BYTES <= before  # with the entry in the audit
    audit.note(session, f"{record.noun}.change", record.id, freeing=freeing)


def _kept(session: Session, record: Resource) -> int:
    kind = type(record)
    return session.scalars(select(kind.kept_bytes).where(kind.id == record.id)).one()


def page(
    store: Store,
    kind: type[Resource],
    filters: Filters = Filters(),  # noqa: B008 (it never changes)
    *,
    limit: int,
    after: str | None,
) -> list[Resource]:
    """Return up to ``limit`` records, newest first, older than ``after`` if it is given.

    They come without the columns that are in no list (``unlisted``).
    """
    left_out = [defer(getattr(kind, name), raiseload=True) for name in kind.unlisted]
    query = _allowed(store, kind, filters, after).options(*left_out).limit(limit)
    with store.reading() as session:
        return list(session.scalars(query))


def identifiers(
    store: Store, kind: type[Resource], filters: Filters, *, limit: int, after: str | None
) -> tuple[list[str], int]:
    """Return the identifiers of a page, and how many records it and those after it have.

    One statement finds both, so that both are of the same moment.
    """
    query = _allowed(store, kind, filters, after).limit(limit)
    with store.reading() as session:
        found = session.execute(query.with_only_columns(kind.id, func.count().over())).all()
    return [identifier for identifier, _ in found], found[0][1] if found else 0


def _allowed(
    store: Store, kind: type[Resource], filters: Filters, after: str | None
) -> Select[Resource]:
    """Return the query of all records that filters allow, newest first, older than ``after``."""
    before, since = filters.created_before, filters.created_after
    query = select(kind).order_by(kind.id.desc())
    if after is not None:
        query = query.where(kind.id < after)
    if filters.ids:
        query = query.where(kind.id.in_(filters.ids))
    if before is not None:
        query = query.where(kind.created_at < before - HALF_A_MICROSECOND)
    if since is not None:
        query = query.where(kind.created_at > since + HALF_A_MICROSECOND)
    dialect = store.engine.dialect.name
    query = query.filter_by(**{n: value for n, value in filters.equal.items() if value is not None})
    query = query.where(*(tagged(dialect, kind, tag) for tag in filters.tags))
    query = query.where(*(mentions(dialect, kind, word) for word in filters.words))
    return query.where(*(says(dialect, kind, *item) for item in filters.metadata.items()))


def _found(record: Resource | None, kind: type[Resource], identifier: str) -> Resource:
    if record is None:
        raise NotFoundError(kind.noun, identifier)
    return record
