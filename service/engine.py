"""The lifting engine: fitted models, read once and kept warm."""

import threading
from collections import OrderedDict

import torch

from models.fitted import FittedPrior
from store import models
from store.database import Store
from store.errors import NotFoundError
from store.records import Model


class Engine:
    """Models in memory, the least recently used given up first. Safe to use from many threads."""

    def __init__(self, store: Store, *, max_bytes: int) -> None:
        """Keep up to ``max_bytes`` of weights, and always the model used last."""
        self._store = store
        self._max_bytes = max_bytes
        self._warm: OrderedDict[str, tuple[FittedPrior, int]] = OrderedDict()
        self._lock = threading.Lock()
        self._loading: dict[str, threading.Lock] = {}
        # Requests run side by side in threads of their own: one core each beats all cores for one.
        torch.set_num_threads(1)

    def prior(self, model_id: str) -> FittedPrior:
        """Return the fitted prior of a model; only the first call of many reads its weights.

        Raises
        ------
        NotFoundError
            If there is no such model, or no longer: the record is asked every time.
        """
        try:
            record = models.get(self._store, model_id)
        except NotFoundError:
            with self._lock:
                self._warm.pop(model_id, None)
            raise
        prior = self._lookup(model_id)
        if prior is None:
            with self._lock:
                loading = self._loading.setdefault(model_id, threading.Lock())
            with loading:
                prior = self._lookup(model_id) or self._load(record)
        return prior

    def _lookup(self, model_id: str) -> FittedPrior | None:
        with self._lock:
            if model_id not in self._warm:
                return None
            self._warm.move_to_end(model_id)
            return self._warm[model_id][0]

    def _load(self, record: Model) -> FittedPrior:
        try:
            prior = FittedPrior.from_bytes(models.load_weights(self._store, record))
        finally:
            with self._lock:
                self._loading.pop(record.id, None)
        with self._lock:
            self._warm[record.id] = (prior, record.weights_bytes)
            while len(self._warm) > 1 and sum(b for _, b in self._warm.values()) > self._max_bytes:
                self._warm.popitem(last=False)
        return prior
