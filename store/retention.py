"""Deleting fits and lifts that ended long ago, where the settings ask for it."""

from typing import NamedTuple

from sqlalchemy import select

from store import audit, clock, fits, lifts
from store.database import Store
from store.errors import ConflictError, NotFoundError
from store.records import FitRecord, LiftRecord

DAY_SECONDS = 24 * 3600.0
AT_A_TIME = 10_000  # of a kind; what is left goes with the next housekeeping


class Retention(NamedTuple):
    """For how many days what has ended is kept; None: for good.

    Attributes
    ----------
    fits, lifts
        That succeeded. With a fit goes its reconstruction, not its model.
    failed
        Fits and lifts that failed or were cancelled.
    audit
        What the audit notes.
    """

    fits: float | None = None
    lifts: float | None = None
    failed: float | None = None
    audit: float | None = None


def outdated(store: Store, keep: Retention) -> list[FitRecord | LiftRecord]:
    """Return what has ended longer ago than it is to be kept, oldest first."""
    found: list[FitRecord | LiftRecord] = []
    kinds: tuple[tuple[type[FitRecord | LiftRecord], float | None], ...] = (
        (FitRecord, keep.fits),
        (LiftRecord, keep.lifts),
    )
    with store.reading() as session:
        for kind, succeeded in kinds:
            for statuses, days in (
                (("succeeded",), succeeded),
                (("failed", "cancelled"), keep.failed),
            ):
                if days is not None:
                    old = kind.finished_at < clock.now() - days * DAY_SECONDS
                    query = select(kind).where(kind.status.in_(statuses), old)
                    found += session.scalars(query.order_by(kind.finished_at).limit(AT_A_TIME))
    return found


def prune(store: Store, keep: Retention) -> list[FitRecord | LiftRecord]:
    """Delete what is outdated and return it; what others still need is left for later."""
    gone: list[FitRecord | LiftRecord] = []
    for job in outdated(store, keep):
        try:
            if isinstance(job, FitRecord):
                fits.delete(store, job.id)
            else:
                lifts.delete(store, job.id)
        except (ConflictError, NotFoundError):
            continue
        gone.append(job)
    if keep.audit is not None:
        audit.forget(store, older_than_seconds=keep.audit * DAY_SECONDS)
    return gone
