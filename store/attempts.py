"""Attempts: what the process that runs a fit may write, for as long as it holds the lease."""

import logging
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from store import clock, fits, jobs, keys, lookup, models, webhooks
from store.answers import PROVISIONAL, provisional_keys
from store.database import Store
from store.disposal import condemn, discard
from store.errors import DamagedError, LeaseLostError
from store.records import FitRecord
from store.reports import Report
from store.version import VERSION

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Attempt:
    """The right to write to a running fit until the lease expires.

    Attributes
    ----------
    number
        The fencing token.
    lease_seconds
        How long the right lasts after each beat.
    """

    fit_id: str
    number: int
    lease_seconds: float


def claim(store: Store, fit_id: str, *, lease_seconds: float) -> Attempt | None:
    """Take a queued fit, or one whose holder's lease has run out; None if neither is so."""
    with store.writing() as session:
        now, prompt = clock.read_promptly(session)
        waiting = FitRecord.status == "queued"
        ran_out = (FitRecord.status == "running") & (FitRecord.lease_expires_at < now)
        number = session.scalar(
            update(FitRecord)
            .where(
                FitRecord.id == fit_id,
                waiting | ran_out if prompt else waiting,
                FitRecord.cancel_requested_at.is_(None),
            )
            .values(
                status="running",
                attempt=FitRecord.attempt + 1,
                revision=FitRecord.revision + 1,
                lease_expires_at=clock.now() + lease_seconds,  # once the record is locked
                started_at=func.coalesce(FitRecord.started_at, now),  # of the first attempt
            )
            .returning(FitRecord.attempt)
        )
    return None if number is None else Attempt(fit_id, number, lease_seconds)


def beat(store: Store, attempt: Attempt, progress: dict[str, Any] | None) -> bool:
    """Keep the lease and publish progress; return whether the user asked to cancel.

    Raises
    ------
    LeaseLostError
        If another attempt or a terminal state has taken this one's place.
    """
    values: dict[str, Any] = {"lease_expires_at": clock.now() + attempt.lease_seconds}
    if progress is not None:
        values |= {"progress": progress, "revision": FitRecord.revision + 1}
    with store.writing() as session:
        asked = _write(session, attempt, values)
    return asked is not None


def save_checkpoint(store: Store, attempt: Attempt, data: bytes) -> None:
    """Replace the fit's checkpoint; raise ``LeaseLostError`` if this attempt is stale."""
    key = keys.of_checkpoint(attempt.fit_id, data)
    store.objects.put(key, data)
    try:
        with store.writing() as session:
            old = session.scalar(
                select(FitRecord.checkpoint_key).where(FitRecord.id == attempt.fit_id)
            )
            size = FitRecord.first_bytes + len(data)
            _write(session, attempt, {"checkpoint_key": key, "stored_bytes": size})
    except LeaseLostError:
        discard(store, key)
        raise
    discard(store, old)


def save_first_answer(
    store: Store, attempt: Attempt, *, model: bytes, reconstruction: bytes, findings: list[Any]
) -> None:
    """Store what geometry found, to be there while the fit goes on, in one transaction.

    It takes the place of one that the fit has, and goes when the fit ends, however it does. Raises
    ``LeaseLostError`` if this attempt is stale.
    """
    first_key = keys.of_reconstruction(attempt.fit_id, reconstruction)
    model_key = keys.of_first_model(attempt.fit_id, model)
    store.objects.put(first_key, reconstruction)
    store.objects.put(model_key, model)
    try:
        with store.writing() as session:
            old = _exchange_first(
                session,
                attempt,
                {"first_key": first_key, "first_model_key": model_key, "findings": findings},
                len(reconstruction) + len(model),
            )
    except LeaseLostError:
        discard(store, first_key, model_key)
        raise
    discard(store, *old)


def withdraw_first_answer(store: Store, attempt: Attempt) -> None:
    """Delete the first answer of an earlier attempt; raise ``LeaseLostError`` as others do."""
    nothing = {"first_key": None, "first_model_key": None, "findings": None}
    with store.writing() as session:
        old = _exchange_first(session, attempt, nothing, 0)
    discard(store, *old)


def _exchange_first(
    session: Session, attempt: Attempt, values: dict[str, Any], size: int
) -> list[str | None]:
    """Write another first answer, of ``size`` bytes; return the keys of the one before."""
    columns = FitRecord.first_key, FitRecord.first_model_key
    old = session.execute(select(*columns).where(FitRecord.id == attempt.fit_id)).first()
    stored = FitRecord.stored_bytes - FitRecord.first_bytes + size
    values |= {"first_bytes": size, "stored_bytes": stored, "revision": FitRecord.revision + 1}
    _write(session, attempt, values)
    return [*(old or ())]


def load_checkpoint(store: Store, fit_id: str) -> bytes | None:
    """Return the last checkpoint of a fit, or None if it has none that can be used."""
    key = lookup.get(store, FitRecord, fit_id).checkpoint_key
    try:
        return None if key is None else store.objects.get(key)
    except (DamagedError, FileNotFoundError):
        logger.exception("Fit %s starts anew: its checkpoint is damaged", fit_id)
        return None


def succeed(
    store: Store,
    attempt: Attempt,
    *,
    weights: bytes,
    reconstruction: bytes,
    progress: dict[str, Any] | None,
    describe: dict[str, Any],
    report: Report | None = None,
) -> str:
    """Store model, reconstruction and report and end the fit, all in one transaction.

    Parameters
    ----------
    progress
        The last progress, for those who did not see it yet.
    describe
        The remaining columns of the model's record.
    report
        On the fit; None if it could not be made.

    Returns
    -------
    str
        The model's identifier.
    """
    fit = lookup.get(store, FitRecord, attempt.fit_id)
    labels = {"name": fit.name, "tags": fit.tags, "user_metadata": fit.user_metadata}
    labels |= {"project": fit.project, "key_id": fit.key_id}
    model = models.new_record(store, weights, fit_id=fit.id, version=VERSION, **labels, **describe)
    reconstruction_key = keys.of_reconstruction(fit.id, reconstruction)
    store.objects.put(reconstruction_key, reconstruction)
    report_key = None if report is None else keys.of_report(fit.id, report.data)
    if report is not None and report_key is not None:
        store.objects.put(report_key, report.data)
    try:
        with store.writing() as session:
            session.add(model)
            _write(
                session,
                attempt,
                fits.ended("succeeded")
                | {
                    "model_id": model.id,
                    "progress": progress,
                    "reconstruction_key": reconstruction_key,
                    "report_key": report_key,
                    "report_words": report and report.words,
                    "stored_bytes": len(reconstruction) + len(report.data if report else b""),
                    "findings": model.findings,
                },
            )
    except LeaseLostError:
        discard(store, model.weights_key, reconstruction_key, report_key)
        raise
    discard(store, *provisional_keys(fit))
    return model.id


def end(
    store: Store, attempt: Attempt, status: str, *, error: dict[str, Any] | None = None
) -> None:
    """End the attempt's fit as ``failed`` or ``cancelled``."""
    with store.writing() as session:
        locked = select(*PROVISIONAL).where(FitRecord.id == attempt.fit_id).with_for_update()
        condemned = condemn(session, [key for keys in session.execute(locked) for key in keys])
        _write(session, attempt, fits.ended(status) | {"error": error})
    discard(store, *condemned)


def release(store: Store, attempt: Attempt) -> None:
    """Put the attempt's fit back to queued, to be resumed from its last checkpoint.

    If the user asked to cancel meanwhile, that is done instead.
    """
    back = {"status": "queued", "lease_expires_at": None, "revision": FitRecord.revision + 1}
    with store.writing() as session:
        asked = _write(session, attempt, back)
        if asked is not None:  # no worker would claim it any more
            session.execute(
                update(FitRecord)
                .where(FitRecord.id == attempt.fit_id)
                .values(**fits.ended("cancelled"))
            )
            _announce(session, attempt)


def give_up(store: Store, attempt: Attempt, why: str) -> None:
    """Give the fit back because of an error; after too many of them it fails.

    Raises
    ------
    NotFoundError
        If the fit was deleted.
    LeaseLostError
        If another attempt or a terminal state has taken this one's place.
    """
    with store.writing() as session:
        fit = lookup.lock(session, FitRecord, attempt.fit_id)
        if fit.attempt != attempt.number or fit.status != "running":
            raise _lost(attempt)
        fits.lose(session, fit, clock.read(session), "internal_error", why)


def _write(session: Session, attempt: Attempt, values: dict[str, Any]) -> float | None:
    """Write as ``attempt``; return when cancellation was asked for, if it was."""
    statement = (
        update(FitRecord)
        .where(
            FitRecord.id == attempt.fit_id,
            FitRecord.attempt == attempt.number,
            FitRecord.status == "running",
        )
        .values(**values)
    )
    row = session.execute(statement.returning(FitRecord.cancel_requested_at)).first()
    if row is None:
        raise _lost(attempt)
    if values.get("status") in jobs.TERMINAL:
        _announce(session, attempt)
    return row[0]


def _announce(session: Session, attempt: Attempt) -> None:
    fit = session.get(FitRecord, attempt.fit_id, populate_existing=True)
    assert fit is not None  # noqa: S101 (it was written just now)
    webhooks.announce(session, fit)


def _lost(attempt: Attempt) -> LeaseLostError:
    return LeaseLostError(f"Attempt {attempt.number} no longer owns fit {attempt.fit_id}.")
