"""Lifts: the state machine of the lift of a whole dataset, which is done in chunks.

    queued ──the first chunk is claimed──▶ running ──the last is finished──▶ succeeded
      └──cancel──────────────────────────────┴──▶ cancelled | failed

``store.lift_chunks`` has what the helpers, who do the chunks, may write. Cancelling needs no
helper's consent: the writes of a chunk count only while its lift is running.
"""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, select
from sqlalchemy import delete as sql_delete
from sqlalchemy.orm import Session

from models.settings.keypoints import MAX_VIEWS
from models.settings.uncertainty import Uncertainty, numbers_of
from store import clock, corrections, jobs, webhooks
from store.account import PART_BYTES
from store.authors import author_of, owned_by
from store.database import Store
from store.disposal import condemn, discard
from store.errors import LiftError, NotFoundError
from store.idempotency import Idempotency
from store.labels import Labels
from store.lookup import lock
from store.records import DatasetRecord, LiftChunk, LiftRecord, ModelRecord

# Keypoints of a chunk over all views, and numbers of their uncertainty: results take some 30 MB.
CHUNK_NUMBERS = 2**20


def create(
    store: Store,
    *,
    model_id: str,
    dataset_id: str,
    name: str,
    refine: str | None = None,
    views: list[int] | None = None,
    frame: str = "canonical",
    up: Sequence[float] | str | None = None,
    uncertainty: Uncertainty = "sd",
    chunk_frames: int,
    labels: Labels = Labels(),  # noqa: B008 (never changed)
    job_id: str | None = None,
    max_queued: int | None = None,
    idempotency: Idempotency | None = None,
) -> LiftRecord:
    """Record a queued lift of the dataset as it is now.

    A ``job_id`` that already has a lift gives that lift back; without one, the lift's own
    identifier is its first job's.

    Parameters
    ----------
    frame, up
        The frame of reference of the result, and up in a room; see `worker.rooms`.
    uncertainty
        How much of it the result has.
    chunk_frames
        Most frames of a chunk; fewer if there are many views and keypoints.

    Raises
    ------
    NotFoundError
        If there is no such dataset or model.
    LiftError
        If the model has other keypoints, or ``views`` does not name the dataset's views.
    QueueFullError
        If ``max_queued`` lifts wait already.
    """

    def make(session: Session, lift_id: str) -> LiftRecord:
        # Locked against deletion, so that no lift is queued of what is gone.
        dataset = lock(session, DatasetRecord, dataset_id)
        model = lock(session, ModelRecord, model_id, dataset.project)
        if model.project != dataset.project:  # jobs may be queued for all projects
            raise NotFoundError("model", model_id)
        _check(views, dataset, model)
        if up is not None and frame != "room":
            raise LiftError("up", "up needs frame=room: give that too, or leave up out")
        chunks = _cut(lift_id, dataset, chunk_frames, uncertainty)
        lift = LiftRecord(
            id=lift_id,
            name=name,
            dataset_id=dataset_id,
            model_id=model.id,
            frames=dataset.frames,
            refine=refine,
            views=views,
            frame=frame,
            up=up,
            uncertainty=uncertainty,
            chunks=len(chunks),
            stored_bytes=len(chunks) * PART_BYTES,
            job_id=job_id or lift_id,
            **corrections.columns(corrections.of(session, DatasetRecord, dataset_id)),
            **owned_by(author_of(session)) | {"project": dataset.project},
            **labels.columns(),
        )
        session.add(lift)
        session.flush()
        session.add_all(chunks)
        return lift

    return jobs.create(
        store, LiftRecord, make, job_id=job_id, max_queued=max_queued, idempotency=idempotency
    )


def _cut(
    lift_id: str, dataset: DatasetRecord, chunk_frames: int, uncertainty: Uncertainty
) -> list[LiftChunk]:
    """Cut a dataset's frames into chunks; fewer frames a chunk where each has many numbers."""
    of_keypoint = dataset.views + numbers_of(uncertainty)
    size = max(1, min(chunk_frames, CHUNK_NUMBERS // (of_keypoint * dataset.keypoints)))
    return [
        LiftChunk(
            lift_id=lift_id,
            first_frame=start,
            frames=min(size, dataset.frames - start),
            crashes=0,
        )
        for start in range(0, dataset.frames, size)
    ]


def _check(views: list[int] | None, dataset: DatasetRecord, model: ModelRecord) -> None:
    """Raise ``LiftError`` for what the worker could not lift."""
    if dataset.keypoints != model.keypoints:
        raise LiftError(
            "dataset_id",
            f"expected a dataset of {model.keypoints} keypoints as in the model, "
            f"got one of {dataset.keypoints}",
        )
    if views is not None and (len(views) != dataset.views or len(set(views)) != len(views)):
        raise LiftError(
            "views",
            f"expected one index per view of the dataset, none twice: {dataset.views}, got {views}",
        )
    if views is not None and max(views) >= MAX_VIEWS:  # integers without end are no JSON
        raise LiftError("views", f"expected indices below {MAX_VIEWS}, got {max(views)}")


def helped(store: Store, job_id: str) -> LiftRecord | None:
    """Return the lift that a queue job asked for, or helps with; or None."""
    with store.reading() as session:
        return session.scalar(select(LiftRecord).where(_asked_by(job_id)))


def _asked_by(job_id: str) -> ColumnElement[bool]:
    return (LiftRecord.job_id == job_id) | (LiftRecord.id == helped_by(job_id))


def helped_by(job_id: str) -> str:
    """Return the identifier of the lift that a job called by another helps, if it is such a job."""
    return job_id.rpartition("-")[0]


def call_next(store: Store, lift_id: str, job_id: str) -> LiftRecord | None:
    """Note that ``job_id`` has started; return the lift if another job may help beside it."""
    with store.writing() as session:
        lift = session.get(LiftRecord, lift_id, with_for_update=True)
        if lift is None or lift.status in jobs.TERMINAL or jobs.waiting_job(lift) != job_id:
            return None
        lift.helpers += 1
        unclaimed = session.scalar(
            select(LiftChunk.first_frame).where(LiftChunk.lift_id == lift_id, *claimable()).limit(1)
        )
    return None if unclaimed is None else lift


def recover(store: Store, *, expired: bool = True) -> list[LiftRecord]:
    """Return the lifts that have chunks for a helper to do, oldest first.

    `expired` as in :func:`store.fits.recover`.
    """
    todo = claimable(expired=expired)
    chunks = select(LiftChunk.first_frame).where(LiftChunk.lift_id == LiftRecord.id, *todo)
    active = LiftRecord.status.in_(("queued", "running"))
    with store.reading() as session:
        return list(
            session.scalars(
                select(LiftRecord).where(active, chunks.exists()).order_by(LiftRecord.id)
            )
        )


def claimable(*, expired: bool = True) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions of a chunk that anyone may do now.

    Parameters
    ----------
    expired
        Whether those count whose holder's lease has run out.
    """
    held_by_nobody = LiftChunk.lease_expires_at.is_(None)
    ran_out = LiftChunk.lease_expires_at < clock.now()
    free = held_by_nobody | ran_out if expired else held_by_nobody
    return LiftChunk.finished_at.is_(None), free


def cancel(store: Store, lift_id: str) -> LiftRecord:
    """Cancel a lift at once, even while workers lift it. Cancelling it again is no error.

    Raises
    ------
    NotFoundError
        If there is no such lift.
    ConflictError
        If it has ended otherwise.
    """
    keys: list[str] = []
    with store.writing() as session:
        lift = jobs.lock_to_cancel(session, LiftRecord, lift_id)
        if lift.status != "cancelled":
            keys = end(session, lift, "cancelled")
    discard(store, *keys)
    return lift


def end(
    session: Session, lift: LiftRecord, status: str, error: dict[str, Any] | None = None
) -> list[str]:
    """End a lift; return the objects that are to be deleted once that is committed.

    Only a lift that succeeded keeps its chunks.
    """
    lift.status, lift.error, lift.finished_at = status, error, clock.read(session)
    lift.seconds_left = None
    lift.revision += 1
    webhooks.announce(session, lift)
    if status == "succeeded":
        return []
    lift.stored_bytes = 0
    return condemn(session, _drop_chunks(session, lift))


def _drop_chunks(session: Session, lift: LiftRecord) -> list[str]:
    gone = session.execute(
        sql_delete(LiftChunk)
        .where(LiftChunk.lift_id == lift.id)
        .returning(LiftChunk.arrays_key, LiftChunk.lines_key)
    )
    return [key for keys in gone for key in keys if key is not None]


def was_cancelled(store: Store, job_id: str, *, patience_seconds: float) -> bool:
    """Return whether the lift that a running job helps with was cancelled some time ago.

    The process that runs it must then be stopped.
    """
    with store.reading() as session:
        cancelled = (_asked_by(job_id)) & (LiftRecord.status == "cancelled")
        long_ago = LiftRecord.finished_at < clock.now() - patience_seconds
        return session.scalar(select(LiftRecord.id).where(cancelled, long_ago)) is not None


def delete(store: Store, lift_id: str) -> None:
    """Delete a lift that has ended, and its result; raises as :func:`store.jobs.delete` does."""
    jobs.delete(store, LiftRecord, lift_id, _drop_chunks)


def finished_chunks(store: Store, lift: LiftRecord) -> list[LiftChunk]:
    """Return the chunks of a lift that are done, in the order of their frames."""
    query = (
        select(LiftChunk)
        .where(LiftChunk.lift_id == lift.id, LiftChunk.finished_at.is_not(None))
        .order_by(LiftChunk.first_frame)
    )
    with store.reading() as session:
        return list(session.scalars(query))
