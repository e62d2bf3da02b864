"""Deleting objects whose records are gone. If it fails, the sweep deletes them later."""

import logging
from collections.abc import Iterable
from threading import BoundedSemaphore, Thread

from obstore.exceptions import BaseError as ObjectStoreError
from sqlalchemy import bindparam, delete
from sqlalchemy.orm import Session

from store import clock
from store.database import Store
from store.engine import insert
from store.objects import Objects
from store.records import CondemnedObject

logger = logging.getLogger(__name__)

PATIENCE_SECONDS = 1.0
_AT_A_TIME = BoundedSemaphore(16)


def condemn(session: Session, keys: Iterable[str | None]) -> list[str]:
    """Have the next sweep delete objects, if this transaction is committed; return their keys.

    For what a user deletes: it goes even if this process dies before :func:`discard`.
    """
    known = [key for key in keys if key is not None]
    if known:
        due = clock.read(session)
        rows = [{"key": key, "due_at": due} for key in sorted(known)]  # all lock them in this order
        condemned = insert(session, CondemnedObject)
        known_due = {"due_at": condemned.excluded.due_at}  # where a sweep has condemned it already
        session.connection().execute(
            condemned.on_conflict_do_update(index_elements=["key"], set_=known_due), rows
        )
    return known


def acquit(session: Session, keys: Iterable[str]) -> None:
    """Forget that objects were condemned."""
    rows = [{"acquitted": key} for key in sorted(keys)]
    if rows:
        mine = CondemnedObject.key == bindparam("acquitted")
        session.connection().execute(delete(CondemnedObject).where(mine), rows)


def discard(store: Store, *keys: str | None) -> None:
    """Delete objects that no record points to, or that none will.

    The caller waits a second at most: there may be thousands, or they may be away.
    """
    known = [key for key in keys if key is not None]
    if not known:
        return
    if not _AT_A_TIME.acquire(blocking=False):  # the objects are away, or slow
        logger.warning("%d objects are left to the sweep: others are being deleted", len(known))
        return
    deleting = Thread(target=_delete, args=(store.objects, known), daemon=True)
    deleting.start()
    deleting.join(PATIENCE_SECONDS)


def _delete(objects: Objects, keys: list[str]) -> None:
    try:
        objects.delete(*keys)
    except (ObjectStoreError, OSError):
        logger.warning("%d objects are left to the sweep", len(keys), exc_info=True)
    finally:
        _AT_A_TIME.release()
