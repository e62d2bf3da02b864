"""Removing what a crash left behind."""

import logging
import time
from typing import NamedTuple

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from store import clock, deployment
from store.database import Store
from store.disposal import acquit
from store.engine import insert
from store.records import (
    Chunk,
    CondemnedObject,
    Deployment,
    FitRecord,
    IdempotencyKey,
    LiftChunk,
    ModelRecord,
)

logger = logging.getLogger(__name__)

SWEEP_SECONDS = 3600.0
ORPHAN_SECONDS = 3600.0  # an object this old belongs to no write still under way
GRACE_SECONDS = 24 * 3600.0  # from an orphan's being noticed to its end
KEY_SECONDS = 24 * 3600.0
LARGEST_SHARE = 0.1  # of all objects: crashes do not leave more, wrong records would
FEW = 20  # whatever share that is
KEYS = (
    Chunk.key,
    FitRecord.checkpoint_key,
    FitRecord.reconstruction_key,
    FitRecord.first_key,
    FitRecord.first_model_key,
    FitRecord.report_key,
    LiftChunk.arrays_key,
    LiftChunk.lines_key,
    ModelRecord.weights_key,
)


class Swept(NamedTuple):
    """How many objects a sweep condemned, and how many it deleted, partial ones among them."""

    condemned: int
    deleted: int


def sweep(
    store: Store,
    *,
    orphan_seconds: float = ORPHAN_SECONDS,
    grace_seconds: float = GRACE_SECONDS,
    dry_run: bool = False,
) -> Swept:
    """Mark objects that no record points to; delete those that were marked long enough ago.

    Objects that a record points to again by then are kept. Idempotency keys a day old are deleted,
    too. A dry run reports what would be deleted, except for leftovers of killed uploads.

    Raises
    ------
    DeploymentError
        If the objects are not those of these records any more.
    """
    deployment.check(store.objects, store.identity)
    # List before reading the records: an object written meanwhile is not in the list.
    old = time.time() - orphan_seconds
    written = dict(store.objects.list())
    with store.writing() as session:
        time_now = clock.read(session)
        due = {one.key: one.due_at for one in session.scalars(select(CondemnedObject))}
        orphans = {key for key, at in written.items() if at < old or key in due}
        orphans -= known_keys(session)
        new = orphans - due.keys()
        if len(new) > max(FEW, LARGEST_SHARE * len(written)):
            logger.error(
                "No record knows %d of %d objects: that is more than crashes leave, so none of "
                "them is condemned. Are these the records of %s?",
                len(new),
                len(written),
                store.objects.url,
            )
            new = set()
        if dry_run:
            return Swept(len(new), sum(due.get(key, time_now + 1) <= time_now for key in orphans))
        if new:
            logger.warning("No record knows %d objects: they are deleted in a day", len(new))
            rows = [{"key": key, "due_at": time_now + grace_seconds} for key in sorted(new)]
            condemned = insert(session, CondemnedObject).on_conflict_do_nothing()
            session.connection().execute(condemned, rows)
            due |= dict.fromkeys(new, time_now + grace_seconds)
        ended = {key for key, at in due.items() if key in orphans and at <= time_now}
        acquit(session, (due.keys() - orphans) | ended)
        session.execute(
            delete(IdempotencyKey).where(IdempotencyKey.created_at < time_now - KEY_SECONDS)
        )
    store.objects.delete(*ended)
    return Swept(len(new), len(ended) + store.objects.delete_partial(old))


def known_keys(session: Session) -> set[str]:
    """Return the keys of all objects that records point to."""
    found = (session.scalars(select(column)) for column in KEYS)
    return {key for keys in found for key in keys if key is not None}


def take_turn(store: Store) -> bool:
    """Return whether a sweep is due, for one caller among all workers: the others hear no."""
    with store.writing() as session:
        taken = session.execute(
            update(Deployment)
            .where(Deployment.next_sweep_at.is_(None) | (Deployment.next_sweep_at < clock.now()))
            .values(next_sweep_at=clock.now() + SWEEP_SECONDS)
            .returning(Deployment.id)
        ).first()
    return taken is not None
