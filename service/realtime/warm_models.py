"""Fitted models, read once and kept warm."""

import gc
import logging
import threading
from collections import OrderedDict
from functools import cache
from typing import NamedTuple

import numpy as np

from models.lifting.fitted_prior import FittedPrior
from store import lookup, models
from store.database import Store
from store.errors import NotFoundError
from store.records import Model

logger = logging.getLogger(__name__)


class _Warm(NamedTuple):
    prior: FittedPrior
    weights_key: str
    weights_bytes: int


class WarmModels:
    """Models in memory, the least recently used given up first. Safe to use from many threads."""

    def __init__(self, store: Store, *, max_bytes: int) -> None:
        """Keep up to ``max_bytes`` of weights, and always the model used last."""
        self._store = store
        self._weights_key = models.weights_keys(store)
        self._max_bytes = max_bytes
        self._warm: OrderedDict[str, _Warm] = OrderedDict()
        self._lock = threading.Lock()
        self._loading: dict[str, threading.Lock] = {}

    def prior(self, model_id: str) -> FittedPrior:
        """Return the fitted prior of a model; only the first call of many reads its weights.

        The record is asked every time, so that a model is not served that was deleted, by whatever
        process, nor other weights than it has.

        Raises
        ------
        NotFoundError
            If there is no such model, or no longer.
        """
        try:
            key = self._weights_key(model_id)
        except NotFoundError:
            with self._lock:
                self._warm.pop(model_id, None)
            raise
        prior = self._lookup(model_id, key)
        if prior is None:
            with self._lock:
                loading = self._loading.setdefault(model_id, threading.Lock())
            with loading:
                prior = self._lookup(model_id, key) or self._load(model_id)
        return prior

    def remembered(self, model_id: str) -> FittedPrior | None:
        """Return a model that is warm without asking whether it is still there."""
        with self._lock:
            warm = self._warm.get(model_id)
        return None if warm is None else warm.prior

    def _lookup(self, model_id: str, key: str) -> FittedPrior | None:
        with self._lock:
            warm = self._warm.get(model_id)
            if warm is None or warm.weights_key != key:
                return None
            self._warm.move_to_end(model_id)
            return warm.prior

    def _load(self, model_id: str) -> FittedPrior:
        try:
            record = lookup.get(self._store, Model, model_id)
            prior = FittedPrior.from_bytes(models.load_weights(self._store, record))
            _prepare(prior)
        finally:
            with self._lock:
                self._loading.pop(model_id, None)
        with self._lock:
            self._warm[model_id] = _Warm(prior, record.weights_key, record.weights_bytes)
            self._warm.move_to_end(model_id)
            while len(self._warm) > 1 and self._bytes() > self._max_bytes:
                self._warm.popitem(last=False)
        return prior

    def warm_newest(self) -> None:
        """Make the newest model warm, and ready what all lifts need, before anyone asks."""
        try:
            for record in lookup.page(self._store, Model, limit=1, after=None):
                self.prior(record.id)
        except Exception:  # whoever asks will be told
            logger.exception("The newest model could not be read")

    def _bytes(self) -> int:
        return sum(warm.weights_bytes for warm in self._warm.values())


def _prepare(prior: FittedPrior) -> None:
    """Lift nothing, once: compiled code is loaded, or even made, when it is first called."""
    nothing = np.full((1, 1, prior.keypoints_per_frame, 2), np.nan, np.float32)
    prior.lift(nothing, refine="full")
    _keep_what_is_loaded()


@cache
def _keep_what_is_loaded() -> None:
    """Take libraries and compiled code out of the search for garbage, once.

    The lists of a JSON batch would have all of them searched again and again, which takes several
    times as long as the lift.
    """
    gc.collect()
    gc.freeze()
