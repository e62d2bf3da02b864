"""Models: fitted priors and their weights."""

import hashlib
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from sqlalchemy import select, update

from store import audit, jobs, keys
from store.authors import owned_by
from store.database import Store
from store.disposal import condemn, discard
from store.errors import ConflictError, DamagedError
from store.idempotency import Idempotency, claim, replayed
from store.ids import new_id
from store.lookup import get, lock, lost
from store.records import FitRecord, LiftRecord, ModelAlias, ModelRecord
from store.space import discarded_if_full
from store.usage import check


class Whereabouts(NamedTuple):
    """Where a model's weights lie, and the fit that made it, if that is still there."""

    weights_key: str
    fit_id: str | None


def new_record(store: Store, weights: bytes, **columns: Any) -> ModelRecord:
    """Store the weights and return the model's record, not yet written."""
    model_id = new_id("mdl")
    key = keys.of_weights(model_id, weights)
    store.objects.put(key, weights)
    return ModelRecord(
        id=model_id,
        created_at=time.time(),
        weights_key=key,
        weights_bytes=len(weights),
        stored_bytes=len(weights),
        weights_checksum=hashlib.sha256(weights).hexdigest(),
        **columns,
    )


def create(
    store: Store, weights: bytes, *, idempotency: Idempotency | None = None, **columns: Any
) -> ModelRecord:
    """Store imported weights as a model, or return the one this request made before."""
    with store.reading() as session:  # before anything is stored in vain
        earlier = replayed(session, idempotency)
        if earlier is None:
            check(session, len(weights))
    if earlier is not None:
        return get(store, ModelRecord, earlier)
    model = new_record(store, weights, **owned_by(store.author), **columns)
    with discarded_if_full(store, model.weights_key), store.writing() as session:
        earlier = claim(session, idempotency, model.id)
        if earlier is None:
            session.add(model)
            audit.note(session, "model.create", model.id)
    if earlier is not None:
        discard(store, model.weights_key)
        return get(store, ModelRecord, earlier)
    return model


def whereabouts(store: Store, model_ids: Sequence[str]) -> dict[str, Whereabouts]:
    """Return of these models those that are there, by identifier."""
    query = select(ModelRecord.id, ModelRecord.weights_key, ModelRecord.fit_id).where(
        ModelRecord.id.in_(model_ids)
    )
    with store.reading() as session:
        return {row.id: Whereabouts(row.weights_key, row.fit_id) for row in session.execute(query)}


def load_weights(store: Store, model: ModelRecord) -> bytes:
    """Return a model's weights.

    Raises
    ------
    NotFoundError
        If it was deleted since its record was read.
    DamagedError
        If they are not those that were stored.
    """
    try:
        weights = store.objects.get(model.weights_key)
    except FileNotFoundError as error:
        raise lost(store, ModelRecord, model.id, error) from error
    if hashlib.sha256(weights).hexdigest() != model.weights_checksum:
        raise DamagedError(model.weights_key)
    return weights


def delete(store: Store, model_id: str) -> None:
    """Delete a model and its weights.

    Raises
    ------
    NotFoundError
        If there is no such model.
    ConflictError
        If it has an alias, or a lift with it, or a fit that starts from it, is queued or running.
    """
    with store.writing() as session:
        # Its fit before the model itself: as all do.
        session.execute(
            update(FitRecord)
            .where(FitRecord.model_id == model_id)
            .values(model_id=None, revision=FitRecord.revision + 1)
        )
        model = lock(session, ModelRecord, model_id)
        alias = session.scalar(select(ModelAlias.name).where(ModelAlias.model_id == model.id))
        if alias is not None:
            raise ConflictError(
                f"Model {model.id!r} has the alias {alias!r}: move or delete that first."
            )
        refuse = partial(jobs.refuse_if_used, session, "Model", model_id)
        refuse(LiftRecord, LiftRecord.model_id == model_id)
        refuse(FitRecord, FitRecord.from_model == model_id)
        condemned = condemn(session, [model.weights_key])
        session.delete(model)
        audit.note(session, "model.delete", model_id)
    discard(store, *condemned)
