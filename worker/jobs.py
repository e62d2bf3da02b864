"""The jobs on the queue: those that people put there, and the call for help with a lift."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from redis import Redis
from rq import get_current_job

from store import attempts, jobs, lift_chunks, lookup
from store.database import Store
from store.errors import NotFoundError
from store.jobs import Job
from store.records import FitRecord, LiftChunk, LiftRecord
from worker import counts
from worker.contract import HelpArguments, KnownJob
from worker.heartbeat import Heartbeat
from worker.patience import patiently
from worker.reconciler import adopt, recorded_as
from worker.settings import WorkerSettings
from worker.time_slice import FitTurn, TimeSlice

logger = logging.getLogger(__name__)

_waiting = partial(patiently, hurry=lambda: False)  # SIGTERM ends what holds no lease


def fit(
    dataset_id: str,
    config: dict[str, Any] | None = None,
    name: str | None = None,
    from_model: str | None = None,
    tags: list[str] | None = None,
    metadata: dict[str, Any] | None = None,
    priority: str = "normal",
) -> dict[str, str | None]:
    """Fit a model to a dataset; the body of ``Queue("fits").enqueue("worker.jobs.fit", ...)``.

    Parameters
    ----------
    dataset_id
        A stored dataset.
    config
        Fields of :class:`models.settings.config.FitConfig`; the others have their defaults.
    name
        A name for people.
    from_model
        A fitted model of the same keypoints, whose weights the fit starts with.
    tags, metadata
        For finding the fit and its model.
    priority
        ``high``, ``normal`` or ``low``, among fits of one project.

    Returns
    -------
    dict
        ``fit_id``, ``status`` and ``model_id``, as ``GET /fits/{id}`` gives them; the last two are
        None where the fit was deleted before it began.

    Raises
    ------
    RuntimeError
        If the fit failed: its code and message, as in the record.
    """
    with _opened() as (job, store, settings):
        fit_id = _waiting(partial(_recorded, store, FitRecord, job, settings))
        if fit_id is None:
            return {"fit_id": recorded_as(job), "status": None, "model_id": None}
        attempt = _waiting(
            partial(attempts.claim, store, fit_id, lease_seconds=settings.lease_seconds)
        )
        if attempt is not None:
            logger.info("Fit %s: attempt %d starts", fit_id, attempt.number)
            if attempt.number > 1:
                counts.add(job.connection, "fit_retries")
            with Heartbeat(partial(attempts.beat, store, attempt)) as heartbeat:
                from worker.fitting import run_attempt  # noqa: PLC0415 (torch takes seconds)

                record = _waiting(partial(lookup.get, store, FitRecord, fit_id))
                turn = FitTurn(job.connection, store, settings, record)
                run_attempt(store, attempt, heartbeat, settings, turn)
        record = _waiting(partial(lookup.get, store, FitRecord, fit_id))
        _report(record)
    return {"fit_id": record.id, "status": record.status, "model_id": record.model_id}


def lift(
    model_id: str,
    dataset_id: str,
    name: str | None = None,
    refine: str | None = None,
    views: list[int] | None = None,
    frame: str = "canonical",
    up: str | list[float] | None = None,
    tags: list[str] | None = None,
    metadata: dict[str, Any] | None = None,
    uncertainty: str = "sd",
) -> dict[str, str | None]:
    """Lift a dataset; the body of ``Queue("fits").enqueue("worker.jobs.lift", ...)``.

    Parameters
    ----------
    model_id, dataset_id
        A fitted model, a stored dataset of the same keypoints.
    name
        A name for people.
    refine, views, frame, up, uncertainty
        As in ``POST /lift``.
    tags, metadata
        For finding the lift.

    Returns
    -------
    dict
        ``lift_id`` and ``status``, as ``GET /lifts/{id}`` gives them. The job may end before its
        lift does: other jobs then continue it.

    Raises
    ------
    RuntimeError
        If the lift failed: its code and message, as in the record.
    """
    with _opened() as (job, store, settings):
        lift_id = _waiting(partial(_recorded, store, LiftRecord, job, settings))
        if lift_id is None:
            return {"lift_id": recorded_as(job), "status": None}
        return _help(job, store, settings, lift_id)


def help_lift(lift_id: str) -> dict[str, str | None]:
    """Lift chunks of a recorded lift until none is left, or other work has waited long enough.

    While there are more chunks than helpers, one such job waits on the queue. The worker that takes
    it puts the next one there, so that every idle worker helps.
    """
    asked = HelpArguments(lift_id=lift_id)  # by a stranger, perhaps
    with _opened() as (job, store, settings):
        return _help(job, store, settings, asked.lift_id)


def _help(
    job: KnownJob, store: Store, settings: WorkerSettings, lift_id: str
) -> dict[str, str | None]:
    helper = lift_chunks.join(lift_id, lease_seconds=settings.lease_seconds)
    claim = partial(_claim, store, helper, job.connection)
    chunk = _waiting(claim)
    if chunk is not None:
        time_slice = TimeSlice(job.connection, settings, lift_id)
        with Heartbeat(partial(lift_chunks.beat, store, helper)) as heartbeat:
            _waiting(partial(time_slice.call_next, store, job.id))
            from worker.lifting import do_chunks  # noqa: PLC0415 (torch takes seconds)

            do_chunks(store, helper, chunk, claim, heartbeat, settings, time_slice)
    try:
        record = _waiting(partial(lookup.get, store, LiftRecord, lift_id))
    except NotFoundError:  # deleted since the job was queued
        return {"lift_id": lift_id, "status": None}
    _report(record)
    return {"lift_id": lift_id, "status": record.status}


def _claim(store: Store, helper: lift_chunks.Helper, connection: Redis) -> LiftChunk | None:
    """Take a chunk of a lift; count if others have tried it before."""
    lost = partial(counts.add, connection, "lift_lease_losses")
    chunk = lift_chunks.claim(store, helper, on_loss=lost)
    if chunk is not None and chunk.crashes:
        counts.add(connection, "lift_retries")
    return chunk


def _recorded(store: Store, kind: type[Job], job: KnownJob, settings: WorkerSettings) -> str | None:
    """Return the identifier of what a job asks for, recorded now if need be; None if deleted."""
    known = jobs.by_job(store, kind, job.id)
    if known is not None:
        return known.id
    return adopt(store, job, settings) if recorded_as(job) is None else None


def _report(record: FitRecord | LiftRecord) -> None:
    """Return the outcome of a job; raise ``RuntimeError`` if it failed, for RQ to see."""
    logger.info("%s: %s", record.id, record.status)
    if record.error is not None:
        raise RuntimeError(f"{record.error['code']}: {record.error['message']}")


@contextmanager
def _opened() -> Iterator[tuple[KnownJob, Store, WorkerSettings]]:
    job = get_current_job()
    assert isinstance(job, KnownJob)  # noqa: S101 (RQ runs these functions in a job)
    settings = WorkerSettings()
    store = _waiting(partial(Store, settings))
    try:
        yield job, store, settings
    finally:
        store.close()
