"""What a module of tests leaves behind, and others after it would meet."""

from contextlib import closing

from sqlalchemy import select

from service.settings import Settings
from store import access_keys, fits
from store.database import Store
from store.records import FitRecord


def end_keys(settings: Settings) -> None:
    """Revoke all keys that are in force, and cancel the fits of all projects that wait."""
    with closing(Store(settings)) as store:
        for key in access_keys.in_force(store):
            access_keys.revoke(store, key.id)
        cancel_waiting(store)


def cancel_waiting(records: Store) -> None:
    """Cancel the fits that wait for a worker."""
    with records.reading() as session:
        waiting = session.scalars(select(FitRecord.id).where(FitRecord.status == "queued")).all()
    for fit_id in waiting:
        fits.cancel(records, fit_id)
