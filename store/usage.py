"""What a key has stored and queued, held against its quotas."""

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from store.authors import author_of
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
    stored = sum(
        session.scalar(select(func.sum(kind.stored_bytes)).where(kind.key_id == author.key_id)) or 0
        for kind in STORED
    )
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
