"""The rooms of models, computed once and kept."""

import threading
from weakref import WeakKeyDictionary

from models.settings.rooms import Up
from service.http.errors import invalid
from service.realtime.warm_models import WarmModel
from store.database import Store
from worker.rooms import Room, find_first_room, find_room

MOST = 64  # rooms of a model kept at once, of a few hundred bytes each


class Rooms:
    """The rooms of models, kept after their first use. Safe to use from many threads.

    A room with up and floor from the frames of a fit is dropped when the fit is deleted.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        # Of each model, for a whole reconstruction may be read.
        self._finding: WeakKeyDictionary[WarmModel, threading.Lock] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def find(self, model: WarmModel, up: Up | None) -> Room:
        """Return the room of a model as :func:`worker.rooms.find_room` does; it may take a while.

        Raises
        ------
        NotFoundError, ConflictError
            If there is no such model, or no room of it.
        """
        room = self.remembered(model, up)
        if room is None:
            with self._lock:
                finding = self._finding.setdefault(model, threading.Lock())
            with finding:
                room = self.remembered(model, up)
                if room is None:
                    source = model.fit_id
                    room = self._find(model, up)
                    if len(model.rooms) >= MOST:
                        model.rooms.clear()
                    model.rooms[source, up] = room
        return room

    def remembered(self, model: WarmModel, up: Up | None) -> Room | None:
        """Return a room that needs no reading of records; None if it does."""
        if up is None:
            return self._find(model, None)
        return model.rooms.get((model.fit_id, up))

    def _find(self, model: WarmModel, up: Up | None) -> Room:
        if model.first_of is not None:
            return find_first_room(self._store, model.first_of, model.prior.cameras, up)
        return find_room(self._store, model.id, model.prior.cameras, up)


def check_known(room: Room, views: list[int] | None, count: int) -> None:
    """Raise ``ApiError`` unless it is known which of the fit's the views of frames are."""
    if not room.knows(views, count):
        fitted = len(room.rotations)
        if count > fitted:
            raise invalid(
                "/views",
                f"expected at most the {fitted} views of the fit, got {count}: frame=room needs "
                "known cameras",
            )
        raise invalid(
            "/views",
            f"expected which {count} of the {fitted} views of the fit these are: "
            "frame=room needs known cameras",
        )
