"""Removing what a crash left behind."""

import time

from sqlalchemy import delete, select

from store.database import Store
from store.records import Chunk, FitJob, IdempotencyKey, LiftChunk, Model

ORPHAN_SECONDS = 3600.0  # an object this old belongs to no write still under way
KEY_SECONDS = 24 * 3600.0


def sweep(store: Store, *, orphan_seconds: float = ORPHAN_SECONDS) -> int:
    """Delete objects that no record points to, and idempotency keys a day old.

    Returns
    -------
    int
        How many objects were deleted, whole and partial.
    """
    # List before reading the records: an object written meanwhile is not in the list.
    old = time.time() - orphan_seconds
    candidates = {key for key, written_at in store.objects.list() if written_at < old}
    with store.reading() as session:
        for column in (
            Chunk.key,
            FitJob.checkpoint_key,
            FitJob.reconstruction_key,
            LiftChunk.arrays_key,
            LiftChunk.lines_key,
            Model.weights_key,
        ):
            candidates.difference_update(session.scalars(select(column)))
    store.objects.delete(*candidates)
    partial = store.objects.delete_partial(old)
    with store.writing() as session:
        session.execute(
            delete(IdempotencyKey).where(IdempotencyKey.created_at < time.time() - KEY_SECONDS)
        )
    return len(candidates) + partial
