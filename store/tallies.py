"""Figures of all that is recorded, for those who watch over a deployment."""

from typing import NamedTuple

from sqlalchemy import func, select

from store import clock
from store.database import Store
from store.housekeeping import SWEEP_SECONDS
from store.records import (
    CondemnedObject,
    Deployment,
    FitRecord,
    LiftChunk,
    LiftRecord,
)
from store.usage import ACCOUNTED

STATUSES = ("queued", "running", "succeeded", "failed", "cancelled")


class Tally(NamedTuple):
    """Figures of fits or of lifts.

    Attributes
    ----------
    jobs
        How many there are, by status.
    oldest_seconds
        Time since the oldest of those that wait was made; 0 where none waits.
    expired
        Running fits, or chunks of lifts, whose lease has run out and which are not taken over yet.
    """

    jobs: dict[str, int]
    oldest_seconds: float
    expired: int


class Tallies(NamedTuple):
    """Figures of a deployment.

    Attributes
    ----------
    kinds
        Of fits and of lifts, by the noun.
    stored_bytes
        Of all that counts in accounts, records included, by the noun in the plural.
    swept_at
        Seconds since the epoch at which the last sweep began; None before the first.
    condemned
        Objects that no record names, which a later sweep deletes.
    """

    kinds: dict[str, Tally]
    stored_bytes: dict[str, int]
    swept_at: float | None
    condemned: int


def read(store: Store) -> Tallies:
    """Return what the records hold now."""
    running = FitRecord.status == "running"
    leases = {
        "fit": select(func.count()).where(running, FitRecord.lease_expires_at < clock.now()),
        "lift": select(func.count()).where(
            LiftChunk.finished_at.is_(None), LiftChunk.lease_expires_at < clock.now()
        ),
    }
    kinds = {}
    with store.reading() as session:
        for kind in (FitRecord, LiftRecord):
            by_status = select(kind.status, func.count()).group_by(kind.status)
            found = dict.fromkeys(STATUSES, 0)
            found.update((status, count) for status, count in session.execute(by_status))
            waited = select(clock.now() - func.min(kind.created_at)).where(kind.status == "queued")
            oldest = max(session.scalar(waited) or 0.0, 0.0)
            kinds[kind.noun] = Tally(found, oldest, session.scalar(leases[kind.noun]) or 0)
        next_sweep = session.scalar(select(Deployment.next_sweep_at))
        return Tallies(
            kinds,
            {
                kind.__tablename__: int(session.scalar(select(func.sum(kind.kept_bytes))) or 0)
                for kind in ACCOUNTED
            },
            None if next_sweep is None else next_sweep - SWEEP_SECONDS,
            session.scalar(select(func.count()).select_from(CondemnedObject)) or 0,
        )
