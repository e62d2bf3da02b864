"""The account of a project: all that it keeps, and what a key has of it, held against its quotas.

Everything counts from its making until it is deleted, whatever its state: objects, records, and
what is noted of requests (see ``store.account``). Whoever has quotas writes one transaction at a
time (``Store.writing``), so what is added up here is what there will be. A full account stops what
would add to it, and no deletion: that is noted in the audit, but so was the making before it, which
counted; so quotas bound the audit, too.
"""

from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from store.authors import Author, author_of
from store.database import Store
from store.errors import QuotaError
from store.records import (
    AuditRecord,
    DatasetRecord,
    Delivery,
    FitRecord,
    IdempotencyKey,
    LiftRecord,
    ModelAlias,
    ModelRecord,
    WebhookRecord,
)

STORED = (DatasetRecord, FitRecord, LiftRecord, ModelRecord)  # which have names, and objects
ACCOUNTED = (*STORED, ModelAlias, WebhookRecord, Delivery, IdempotencyKey, AuditRecord)
NAMED = 3  # kinds that the error of a full account names
# What nobody can delete goes by itself.
GOES = {
    Delivery.__tablename__: "a week after they ended, or with their webhook",
    IdempotencyKey.__tablename__: "after a day",
    AuditRecord.__tablename__: "when the service has kept them for as long as it is set to",
}


class Kept(NamedTuple):
    """How many records there are of a kind, and the bytes of these and of their objects."""

    records: int
    size: int


def check(session: Session, more: int = 0) -> None:
    """Raise ``QuotaError`` if an author's account holds more than it may.

    Parameters
    ----------
    more
        Bytes that would come on top of what this transaction has written.
    """
    author = author_of(session)
    if author is None or author.quotas.stored_bytes is None:
        return
    session.flush()
    own = _own(session, author)
    stored = sum(kept.size for kept in own.values()) + more
    if stored > author.quotas.stored_bytes:
        largest = sorted(own, key=lambda name: -own[name].size)[:NAMED]
        listed = "; ".join(_in_words(name, own[name]) for name in largest)
        raise QuotaError(
            f"This key may keep {author.quotas.stored_bytes} bytes, and would keep {stored}"
            f"{f' ({listed})' if listed else ''}. Delete what is not needed (GET /storage shows "
            "what counts), or ask who keeps the service."
        )


def left(store: Store) -> int | None:
    """Return the bytes that an author may still keep; None where that is not bounded."""
    author = store.author
    if author is None or author.quotas.stored_bytes is None:
        return None
    with store.reading() as session:
        kept = sum(kept.size for kept in _own(session, author).values())
    return max(0, author.quotas.stored_bytes - kept)


def check_queue(session: Session) -> None:
    """Raise ``QuotaError`` if as many of the author's jobs wait as may, or the space is used up."""
    author = author_of(session)
    if author is None:
        return
    check(session, 1)  # of a result of unknown size
    if author.quotas.queued_jobs is None:
        return
    waiting = sum(
        session.scalar(
            select(func.count(kind.id)).where(kind.key_id == author.key_id, kind.status == "queued")
        )
        or 0
        for kind in (FitRecord, LiftRecord)
    )
    if waiting >= author.quotas.queued_jobs:
        raise QuotaError(
            f"This key may have {author.quotas.queued_jobs} fits and lifts waiting, and has "
            f"{waiting}. Try again when some have run."
        )


class StoredItem(NamedTuple):
    """Something stored, and how many bytes its record and objects have."""

    kind: str  # a noun in the plural
    id: str
    name: str
    stored_bytes: int


class Usage(NamedTuple):
    """What is kept of a project, and of what its author made.

    Attributes
    ----------
    project, own
        By the noun in the plural.
    largest
        The largest first.
    """

    project: dict[str, Kept]
    own: dict[str, Kept]
    largest: list[StoredItem]


def usage(store: Store, most: int) -> Usage:
    """Return what is kept where the author of the store sees it, and so many of the largest."""
    items = []
    with store.reading() as session:
        account = _account(session, author_of(session))
        for kind in STORED:
            largest = select(kind.id, kind.name, kind.kept_bytes)
            largest = largest.order_by(kind.kept_bytes.desc(), kind.id).limit(most)
            items += [StoredItem(kind.__tablename__, *row) for row in session.execute(largest)]
    items.sort(key=lambda item: (-item.stored_bytes, item.id))
    return Usage(
        {name: project for name, (project, _) in account.items()},
        {name: own for name, (_, own) in account.items()},
        items[:most],
    )


def _own(session: Session, author: Author) -> dict[str, Kept]:
    """Return what there is of an author's, by kind."""
    return {name: kept for name, (_, kept) in _account(session, author).items() if kept.records}


def _account(session: Session, author: Author | None) -> dict[str, tuple[Kept, Kept]]:
    """Return what there is of each kind in the author's project, and what of it is the author's.

    Of all projects, and nobody's, without an author.
    """
    found = {}
    for kind in ACCOUNTED:
        query = select(kind.key_id, func.count(), func.sum(kind.kept_bytes)).group_by(kind.key_id)
        if author is not None:
            query = query.where(kind.project == author.project)
        by_key = {key: Kept(count, int(size)) for key, count, size in session.execute(query)}
        own = None if author is None else by_key.get(author.key_id)
        records, sizes = zip(*by_key.values(), strict=True) if by_key else ((), ())
        project = Kept(sum(records), sum(sizes))
        found[kind.__tablename__] = project, own or Kept(0, 0)
    return found


def _in_words(name: str, kept: Kept) -> str:
    goes = f", which go {GOES[name]}" if name in GOES else ""
    return f"{kept.records} {name.replace('_', ' ')} with {kept.size} bytes{goes}"
