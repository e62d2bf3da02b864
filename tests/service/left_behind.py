"""What a module of tests leaves behind, and others after it would meet."""

from contextlib import closing
from typing import Any

from sqlalchemy import select

from service.settings import Settings
from store import access_keys, fits
from store.database import Store
from store.records import DatasetRecord, FitRecord, LiftRecord, ModelRecord


def stored(records: Store, settings: Settings) -> list[Any]:
    """Return all resources and objects there are: HTTP would take far longer to list them."""
    with records.engine.connect() as connection:
        rows = [
            sorted(map(repr, connection.execute(select(kind.__table__))))
            for kind in (DatasetRecord, FitRecord, ModelRecord, LiftRecord)
        ]
    return [*rows, sorted(p for p in (settings.data_dir / "objects").rglob("*") if p.is_file())]


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
