"""Fitted models, read once and kept warm."""

import gc
import logging
import threading
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import islice
from weakref import WeakValueDictionary

import numpy as np

from models.lifting.fitted_prior import FittedPrior
from models.numerics.compiled import load_machine_code
from models.settings.rooms import BestFrame, Up
from store import aliases, answers, lookup, models
from store.database import Store
from store.errors import NotFoundError
from store.records import FitRecord, ModelRecord
from worker.rooms import Room, first_frame, has_room

logger = logging.getLogger(__name__)

LOOK_SECONDS = 1.0  # between two looks at the records
MOST_AHEAD = 32  # models made warm at a look, before anyone asks for them
MOST_FIRST = 4  # models of first answers kept at once


@dataclass(eq=False, slots=True, weakref_slot=True)
class WarmModel:
    """A model in memory, shared by all lifts with it.

    Attributes
    ----------
    fit_id
        The fit that made it, if that is still there.
    measured_frame
        The best frame of reference of the fit's frames; None for an older or an imported model.
    ready
        The compiled code that it needs to lift is loaded.
    gone
        It was deleted, by any process, and must not be used any more.
    rooms
        Its known rooms, by the fit that they were estimated from and by up.
    first_of
        The fit whose first answer it is of, before there is a model; nothing is lifted with it.
    """

    id: str
    project: str
    prior: FittedPrior
    weights_key: str
    weights_bytes: int
    fit_id: str | None
    measured_frame: BestFrame | None = None
    ready: bool = False
    gone: bool = False
    rooms: dict[tuple[str | None, Up | None], Room] = field(default_factory=dict)
    first_of: FitRecord | None = None

    @property
    def best_frame(self) -> BestFrame:
        """The best frame of reference that can be asked for."""
        if self.fit_id is not None and self.measured_frame is not None:
            return self.measured_frame
        return "room" if has_room(self.prior.cameras) else "canonical"


class WarmModels:
    """Models in memory, of which those used longest ago are dropped. Safe to use from many threads.

    A separate thread checks once a second which models still exist. So lifts continue while the
    records cannot be read, and a model that any process deleted is served for at most a second
    longer.
    """

    def __init__(self, store: Store, *, max_bytes: int) -> None:
        """Keep up to ``max_bytes`` of weights, and always the model used last."""
        self._store = store
        self._max_bytes = max_bytes
        self._used: WeakValueDictionary[str, WarmModel] = WeakValueDictionary()  # also by streams
        self._kept: OrderedDict[str, WarmModel] = OrderedDict()
        self._first: OrderedDict[str, WarmModel] = OrderedDict()  # of first answers, by their key
        self._lock = threading.Lock()
        self._loading: dict[str, threading.Lock] = {}
        self._aliases: dict[tuple[str, str], str] = {}  # by project and name
        self._newest: str | None = None  # model, at the last look
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="warm-models", daemon=True)
        self._watcher.start()

    def close(self) -> None:
        """Look at the records no more."""
        self._closed.set()
        self._watcher.join(LOOK_SECONDS)

    def warm(self, project: str, identifier: str) -> WarmModel | None:
        """Return a model of a project that is ready to lift; it waits for nothing.

        Parameters
        ----------
        identifier
            The model's, or an alias of it.
        """
        model_id = self._aliases.get((project, identifier), identifier)
        model = self._in_memory(project, model_id)
        return model if model is not None and model.ready else None

    def get(self, project: str, identifier: str) -> WarmModel:
        """Return a model that is ready to lift; see :meth:`read`."""
        model = self.read(project, identifier)
        if not model.ready:
            _prepare(model.prior)
            model.ready = True
        return model

    def read(self, project: str, identifier: str) -> WarmModel:
        """Return a model as it is in the records; only the first call reads its weights.

        It may not be ready to lift: to load compiled code takes a second.

        Parameters
        ----------
        identifier
            The model's, or an alias of it.

        Raises
        ------
        NotFoundError
            If the project has no such model, or no longer.
        """
        model_id = identifier
        if lookup.is_alias(identifier):
            with self._store.reading() as session:
                model_id = lookup.resolved(session, ModelRecord, identifier, project)
        model = self._in_memory(project, model_id)
        if model is not None:
            self._compare([model])
            if not model.gone:
                return model
        with self._lock:
            loading = self._loading.setdefault(model_id, threading.Lock())
        with loading:
            return self._in_memory(project, model_id) or self._load(project, model_id)

    def first(self, fit: FitRecord) -> WarmModel:
        """Return the model of a fit's first answer, for its cameras and its room.

        Raises
        ------
        NotFoundError, ConflictError
            If the fit was deleted, or has ended since its record was read.
        """
        key = str(fit.first_model_key)
        with self._lock:
            model = self._first.get(key)
        if model is None:
            data = answers.load_first_model(self._store, fit)
            prior = FittedPrior.from_bytes(data)
            model = WarmModel(fit.id, fit.project, prior, key, len(data), fit.id, first_of=fit)
            model.measured_frame = first_frame(self._store, fit, prior.cameras)
            with self._lock:
                self._first[key] = model
                while len(self._first) > MOST_FIRST:
                    self._first.popitem(last=False)
        return model

    def look(self) -> None:
        """Read where aliases point to; they point there once the model is warm."""
        found = aliases.targets(self._store)
        moved = {
            (alias[0], model_id)
            for alias, model_id in found.items()
            if self._aliases.get(alias) != model_id
        }
        self._warm_ahead(moved)
        self._aliases = found

    def forget(self, model_id: str) -> None:
        """Give up a model that this process has deleted."""
        with self._lock:
            model = self._used.get(model_id)
            if model is not None:
                self._give_up(model)

    def _watch(self) -> None:
        """Follow aliases, and give up what is gone, unless the records cannot be asked."""
        blind = False
        while not self._closed.wait(LOOK_SECONDS):
            with self._lock:
                known = list(self._used.values())
            try:
                self.look()
                self._look_at_newest()
                if known:
                    self._compare(known)
                blind = False
            except Exception:  # whatever it is: it must not end the watch
                if not blind:
                    logger.exception("Cannot ask which models are there: lifting goes on")
                blind = True

    def _compare(self, known: Sequence[WarmModel]) -> None:
        there = models.whereabouts(self._store, [model.id for model in known])
        with self._lock:
            for model in known:
                record = there.get(model.id)
                if record is not None and record.weights_key == model.weights_key:
                    model.fit_id = record.fit_id
                    continue
                self._give_up(model)

    def _give_up(self, model: WarmModel) -> None:
        model.gone = True
        for models_by_id in (self._used, self._kept):
            if models_by_id.get(model.id) is model:
                del models_by_id[model.id]

    def _in_memory(self, project: str, model_id: str) -> WarmModel | None:
        with self._lock:
            model = self._used.get(model_id)
            if model is None or model.project != project:
                return None
            self._keep(model)
        return model

    def _load(self, project: str, model_id: str) -> WarmModel:
        try:
            record = lookup.get(self._store, ModelRecord, model_id)
            if record.project != project:
                raise NotFoundError(ModelRecord.noun, model_id)
            prior = FittedPrior.from_bytes(models.load_weights(self._store, record))
        finally:
            with self._lock:
                self._loading.pop(model_id, None)
        loaded = WarmModel(
            model_id,
            project,
            prior,
            record.weights_key,
            record.weights_bytes,
            record.fit_id,
            record.metrics.get("frame_of_reference"),
        )
        with self._lock:
            model = self._used.setdefault(model_id, loaded)  # or another's: only one is watched
            self._keep(model)
        return model

    def _keep(self, model: WarmModel) -> None:
        self._kept[model.id] = model
        self._kept.move_to_end(model.id)
        while len(self._kept) > 1 and self._bytes() > self._max_bytes:
            del self._kept[self._dispensable(model).id]

    def begin(self) -> None:
        """Make warm what will be asked for, and load the code of all lifts, before anyone asks."""
        try:
            self._look_at_newest()
            self.look()
            load_machine_code()
        except Exception:  # the next caller gets the error
            logger.exception("Models could not be read ahead")

    def _look_at_newest(self) -> None:
        """Make the newest model warm, if it is another than at the look before."""
        for record in lookup.page(self._store, ModelRecord, limit=1, after=None):
            if record.id != self._newest:
                self._newest = record.id
                self._warm_ahead([(record.project, record.id)])

    def _warm_ahead(self, wanted: Iterable[tuple[str, str]]) -> None:
        """Make some models warm, by project and identifier, as far as there is place for them."""
        for project, model_id in islice(wanted, MOST_AHEAD):
            try:
                record = lookup.get(self._store, ModelRecord, model_id)
                with self._lock:
                    fits = self._bytes() + record.weights_bytes <= self._max_bytes
                if fits or not self._kept:
                    self.get(project, model_id)
            except NotFoundError:
                continue
            except Exception:  # the next caller gets the error
                logger.exception("Model %s could not be read ahead", model_id)

    def _bytes(self) -> int:
        return sum(model.weights_bytes for model in self._kept.values())

    def _dispensable(self, newest: WarmModel) -> WarmModel:
        """Return the model that is dropped: of the project with most bytes, that used longest ago.

        So a project that uses many models drops its own, and nobody else's.
        """
        others = [model for model in self._kept.values() if model is not newest]
        sizes: Counter[str] = Counter()
        for model in self._kept.values():
            sizes[model.project] += model.weights_bytes
        return max(others, key=lambda model: sizes[model.project])  # of equals the first


def _prepare(prior: FittedPrior) -> None:
    """Lift nothing, once: compiled code is loaded, or even made, when it is first called."""
    views = max(prior.known_views, 1)
    nothing = np.full((1, views, prior.keypoints_per_frame, 2), np.nan, np.float32)
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
