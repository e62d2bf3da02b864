"""Fits: the state machine of a fit job.

    queued ──claim──▶ running ──▶ succeeded | failed | cancelled
      ▲  │               │
      │  └──cancel───────┼──────▶ cancelled
      └──released, or its lease expired

Only the attempt that holds the lease may write; terminal states are never left. The queue carries
work to workers and nothing more: what it says of a job is never asked.
"""

import time
from typing import Any

from sqlalchemy import func, select, update

from store.database import Store
from store.errors import ConfigError, ConflictError, NotFoundError, QueueFullError
from store.idempotency import Idempotency, remember, replayed
from store.ids import new_id
from store.records import Dataset, Fit, Model

TERMINAL = ("succeeded", "failed", "cancelled")
MAX_CRASHES = 5


def create(
    store: Store,
    *,
    dataset_id: str,
    name: str,
    config: dict[str, Any],
    job_id: str | None = None,
    max_queued: int | None = None,
    idempotency: Idempotency | None = None,
) -> Fit:
    """Record a queued fit of the dataset as it is now.

    A ``job_id`` that already has a fit gives that fit back; without one, the fit's own identifier
    is its job's.

    Raises
    ------
    NotFoundError
        If there is no such dataset.
    ConfigError
        If the configuration speaks of views or keypoints that the dataset has not.
    QueueFullError
        If ``max_queued`` fits wait already.
    """
    fit_id = new_id("fit")
    with store.writing() as session:
        earlier = replayed(session, idempotency)
        if earlier is None and job_id is not None:
            earlier = session.scalar(select(Fit.id).where(Fit.job_id == job_id))
        if earlier is None:
            waiting = select(func.count()).select_from(Fit).where(Fit.status == "queued")
            if max_queued is not None and (session.scalar(waiting) or 0) >= max_queued:
                raise QueueFullError(f"{max_queued} fits are waiting already.")
            # Locked against deletion, so that no fit is queued of a dataset that is gone.
            dataset = session.get(Dataset, dataset_id, with_for_update=True)
            if dataset is None:
                raise NotFoundError("dataset", dataset_id)
            _check(config, dataset)
            fit = _new(
                id=fit_id,
                name=name,
                dataset_id=dataset_id,
                frames=dataset.frames,
                config=config,
                job_id=job_id or fit_id,
            )
            session.add(fit)
            remember(session, idempotency, fit_id)
    return fit if earlier is None else get(store, earlier)


def _check(config: dict[str, Any], dataset: Dataset) -> None:
    """Raise ``ConfigError`` for what a configuration cannot know by itself."""
    calibration, known_length = config.get("calibration"), config.get("known_length")
    if calibration is not None and len(calibration) != dataset.views:
        raise ConfigError(
            "calibration",
            f"the calibration must have an entry per view: expected {dataset.views}, got "
            f"{len(calibration)}; write null for a view of which nothing is known",
        )
    for field, found in (
        ("known_length", known_length and known_length["keypoints"]),
        ("handedness", config.get("handedness")),
    ):
        if found and (len(set(found)) < len(found) or max(found) >= dataset.keypoints):
            raise ConfigError(
                field,
                f"{field} must name {len(found)} different keypoints below {dataset.keypoints}, "
                f"got {list(found)}",
            )


def refuse(
    store: Store,
    *,
    dataset_id: str,
    name: str,
    config: dict[str, Any],
    job_id: str,
    error: dict[str, Any],
) -> str:
    """Record a job that can never run, so that whoever queued it can read why; return the fit."""
    with store.writing() as session:
        known = session.scalar(select(Fit.id).where(Fit.job_id == job_id))
        if known is not None:
            return known
        fit = _new(
            id=new_id("fit"),
            name=name,
            dataset_id=dataset_id,
            frames=0,
            config=config,
            job_id=job_id,
        )
        fit.status, fit.error, fit.finished_at = "failed", error, fit.created_at
        session.add(fit)
    return fit.id


def _new(**columns: Any) -> Fit:
    return Fit(created_at=time.time(), status="queued", revision=1, attempt=0, crashes=0, **columns)


def get(store: Store, fit_id: str) -> Fit:
    """Return the record of a fit; raise ``NotFoundError`` if there is none."""
    with store.reading() as session:
        fit = session.get(Fit, fit_id)
    if fit is None:
        raise NotFoundError("fit", fit_id)
    return fit


def by_job(store: Store, job_id: str) -> Fit | None:
    """Return the fit that a queue job carries, or None."""
    with store.reading() as session:
        return session.scalar(select(Fit).where(Fit.job_id == job_id))


def page(
    store: Store,
    *,
    limit: int,
    after: str | None,
    status: str | None = None,
    dataset_id: str | None = None,
    job_id: str | None = None,
) -> list[Fit]:
    """Return up to ``limit`` fits, newest first, older than ``after`` if it is given."""
    query = select(Fit).order_by(Fit.id.desc()).limit(limit)
    if after is not None:
        query = query.where(Fit.id < after)
    for column, value in (
        (Fit.status, status),
        (Fit.dataset_id, dataset_id),
        (Fit.job_id, job_id),
    ):
        if value is not None:
            query = query.where(column == value)
    with store.reading() as session:
        return list(session.scalars(query))


def request_cancel(store: Store, fit_id: str) -> Fit:
    """Cancel a queued fit at once, or ask the attempt that runs it to stop.

    Cancelling a cancelled fit is no error.

    Raises
    ------
    NotFoundError
        If there is no such fit.
    ConflictError
        If it has ended otherwise.
    """
    now = time.time()
    with store.writing() as session:
        fit = session.get(Fit, fit_id, with_for_update=True)
        if fit is None:
            raise NotFoundError("fit", fit_id)
        if fit.status in ("succeeded", "failed"):
            raise ConflictError(f"Fit {fit_id!r} has already {fit.status}; it cannot be cancelled.")
        if fit.status != "cancelled" and fit.cancel_requested_at is None:
            fit.cancel_requested_at = now
            fit.revision += 1
        abandoned = fit.lease_expires_at is not None and fit.lease_expires_at < now
        if fit.status == "queued" or (fit.status == "running" and abandoned):
            _end(fit, "cancelled", now)
    return fit


def recover(store: Store) -> list[Fit]:
    """Deal with fits whose attempt died; return all queued fits, oldest first.

    A fit whose lease ran out is queued again, or cancelled if that was asked, or failed if it has
    taken down too many workers.
    """
    now = time.time()
    lost = (Fit.status == "running") & (Fit.lease_expires_at < now)
    queued = select(Fit).where(Fit.status == "queued").order_by(Fit.id)
    with store.reading() as session:  # the common case takes no write lock
        any_lost = session.scalar(select(Fit.id).where(lost).limit(1)) is not None
    if any_lost:
        with store.writing() as session:
            for fit in session.scalars(select(Fit).where(lost).with_for_update(skip_locked=True)):
                _lose(fit, now)
    with store.reading() as session:
        return list(session.scalars(queued))


def _lose(fit: Fit, now: float) -> None:
    fit.crashes += 1
    fit.revision += 1
    fit.lease_expires_at = None
    if fit.cancel_requested_at is not None:
        _end(fit, "cancelled", now)
    elif fit.crashes >= MAX_CRASHES:
        _end(fit, "failed", now)
        fit.error = {
            "code": "worker_lost",
            "message": f"The worker died {fit.crashes} times while fitting; it may have run out "
            "of memory. Try fewer frames or smaller dictionaries.",
        }
    else:
        fit.status = "queued"


def enforce_cancel(store: Store, job_id: str, *, patience_seconds: float) -> bool:
    """Take a running fit from an attempt that has not heeded a request to cancel.

    Returns
    -------
    bool
        Whether it was taken; whoever runs it must then be stopped.
    """
    now = time.time()
    with store.reading() as session:
        asked = session.scalar(
            select(Fit.cancel_requested_at).where(Fit.job_id == job_id, Fit.status == "running")
        )
    if asked is None or now - asked < patience_seconds:
        return False
    with store.writing() as session:
        taken = session.execute(
            update(Fit)
            .where(Fit.job_id == job_id, Fit.status == "running")
            .values(**ended("cancelled"))
            .returning(Fit.id)
        ).first()
    return taken is not None


def delete(store: Store, fit_id: str) -> None:
    """Delete a fit that has ended, and its reconstruction; its model stays.

    Raises
    ------
    NotFoundError
        If there is no such fit.
    ConflictError
        If it is queued or running.
    """
    with store.writing() as session:
        fit = session.get(Fit, fit_id, with_for_update=True)
        if fit is None:
            raise NotFoundError("fit", fit_id)
        if fit.status not in TERMINAL:
            raise ConflictError(f"Fit {fit_id!r} is {fit.status}: cancel it first.")
        session.execute(update(Model).where(Model.fit_id == fit_id).values(fit_id=None))
        session.delete(fit)
    store.objects.delete(fit.reconstruction_key, fit.checkpoint_key)


def ended(status: str) -> dict[str, Any]:
    """Return the columns of a fit that ends now. It needs its checkpoint no more."""
    return {
        "status": status,
        "finished_at": time.time(),
        "lease_expires_at": None,
        "checkpoint_key": None,
        "revision": Fit.revision + 1,
    }


def _end(fit: Fit, status: str, now: float) -> None:
    fit.status, fit.finished_at = status, now
    fit.lease_expires_at = fit.checkpoint_key = None  # the sweep removes the checkpoint itself


def load_reconstruction(store: Store, fit: Fit) -> bytes:
    """Return the reconstruction of a fit (safetensors).

    Raises
    ------
    NotFoundError
        If the fit was deleted since its record was read.
    ConflictError
        If it has none, for it did not succeed.
    """
    if fit.reconstruction_key is None:
        raise ConflictError(f"Fit {fit.id!r} is {fit.status}: only a fit that succeeded has one.")
    try:
        return store.objects.get(fit.reconstruction_key)
    except FileNotFoundError as error:
        raise NotFoundError("fit", fit.id) from error
