"""What is stored, by whom, and what a key has stored and queued, held against its quotas."""

from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from store.authors import Author, author_of
from store.database import Store
from store.errors import QuotaError
from store.locks import alone
from store.records import DatasetRecord, FitRecord, LiftRecord, ModelRecord

STORED = (DatasetRecord, FitRecord, LiftRecord, ModelRecord)


def check_space(session: Session, more: int) -> None:
    """Raise ``QuotaError`` if an author who stores so many bytes more goes beyond the quota."""
    author = author_of(session)
    if author is None or author.quotas.stored_bytes is None:
        return
    alone(session, f"quotas of {author.key_id}")
    stored = _stored_by(session, author)
    if stored + more > author.quotas.stored_bytes:
        raise QuotaError(
            f"This key may store {author.quotas.stored_bytes} bytes; it has stored {stored}, and "
            f"this needs {more} more. Delete what is not needed, or ask who keeps the service."
        )


def check_queue(session: Session) -> None:
    """Raise ``QuotaError`` if as many of the author's jobs wait as may, or the space is used up."""
    author = author_of(session)
    if author is None:
        return
    check_space(session, 1)  # of a result of unknown size
    if author.quotas.queued_jobs is None:
        return
    alone(session, f"quotas of {author.key_id}")
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
    """Something stored, and how many bytes of objects it has."""

    kind: str  # a noun in the plural
    id: str
    name: str
    stored_bytes: int


class Usage(NamedTuple):
    """What is stored of a project, and by its author.

    Attributes
    ----------
    counts, stored_bytes
        By the noun in the plural; fits have the bytes of their reconstructions.
    largest
        The largest first.
    by_author
        Bytes that the author has stored; None without one.
    """

    counts: dict[str, int]
    stored_bytes: dict[str, int]
    largest: list[StoredItem]
    by_author: int | None


def usage(store: Store, most: int) -> Usage:
    """Return what is stored where the author of the store sees it, and so many of the largest."""
    counts, stored_bytes, items = {}, {}, []
    with store.reading() as session:
        author = author_of(session)
        for kind in STORED:
            found = session.execute(select(func.count(kind.id), func.sum(kind.stored_bytes))).one()
            counts[kind.__tablename__], stored_bytes[kind.__tablename__] = found[0], found[1] or 0
            largest = select(kind.id, kind.name, kind.stored_bytes).where(kind.stored_bytes > 0)
            largest = largest.order_by(kind.stored_bytes.desc(), kind.id).limit(most)
            items += [StoredItem(kind.__tablename__, *row) for row in session.execute(largest)]
        by_author = None if author is None else _stored_by(session, author)
    items.sort(key=lambda item: (-item.stored_bytes, item.id))
    return Usage(counts, stored_bytes, items[:most], by_author)


def _stored_by(session: Session, author: Author) -> int:
    return sum(
        session.scalar(select(func.sum(kind.stored_bytes)).where(kind.key_id == author.key_id)) or 0
        for kind in STORED
    )
