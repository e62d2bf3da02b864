"""What a fit answers: the first answer, of geometry, while it goes on; then its reconstruction."""

from typing import Literal

from store.database import Store
from store.errors import ConflictError
from store.lookup import lost
from store.records import FitRecord

AnswerStage = Literal["geometry", "network"]  # what made a reconstruction
# What a fit has only while it goes on: its checkpoint, and its first answer.
PROVISIONAL = (FitRecord.checkpoint_key, FitRecord.first_key, FitRecord.first_model_key)
_WAIT = (
    "its reconstruction is there when geometry has found static cameras (its `answer_stage` is "
    "`geometry` then), or else when it has succeeded."
)


def provisional_keys(fit: FitRecord) -> list[str]:
    """Return the keys of what a fit has only while it goes on."""
    keys = (getattr(fit, column.key) for column in PROVISIONAL)
    return [key for key in keys if key is not None]


def answer_stage(fit: FitRecord) -> AnswerStage | None:
    """Return what made the reconstruction that a fit has now; None if it has none."""
    if fit.reconstruction_key is not None:
        return "network"
    return None if fit.first_key is None else "geometry"


def reconstruction_key(fit: FitRecord) -> str:
    """Return where the reconstruction of a fit is, that of its first answer while it goes on.

    Raises ``ConflictError`` if it has none.
    """
    key = fit.reconstruction_key or fit.first_key
    if key is None:
        waiting = fit.status in ("queued", "running")
        why = _WAIT if waiting else "only a fit that succeeded has a reconstruction."
        raise ConflictError(f"Fit {fit.id!r} is {fit.status}: {why}")
    return key


def load_reconstruction(store: Store, fit: FitRecord) -> bytes:
    """Return the reconstruction of a fit (safetensors).

    Raises
    ------
    NotFoundError
        If the fit was deleted since its record was read.
    ConflictError
        If it has none, for it did not succeed, or ended since its record was read.
    DamagedError
        If it is not what was stored.
    """
    return _load(store, fit, reconstruction_key(fit))


def load_first_model(store: Store, fit: FitRecord) -> bytes:
    """Return the model of a fit's first answer; raise as `load_reconstruction` does."""
    if fit.first_model_key is None:
        raise ConflictError(f"Fit {fit.id!r} has no first answer.")
    return _load(store, fit, fit.first_model_key)


def _load(store: Store, fit: FitRecord, key: str) -> bytes:
    try:
        return store.objects.get(key)
    except FileNotFoundError as error:
        raise lost(store, FitRecord, fit.id, error) from error
