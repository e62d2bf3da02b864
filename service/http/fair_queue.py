"""Fair turns: who waits for much keeps nobody else waiting."""

from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Generic, TypeVar

Item = TypeVar("Item")
Path = tuple[Hashable, ...]  # the project, the key, and more where these have several lanes


class FairQueue(Generic[Item]):
    """Items in fair turns: one of each project, and of a project's one of each key, and so on.

    Items of one path come in their order. Not safe to use from several threads.
    """

    def __init__(self) -> None:
        self._lanes: OrderedDict[Hashable, FairQueue[Item]] = OrderedDict()
        self._items: deque[Item] = deque()  # of this very path

    def __bool__(self) -> bool:
        """Whether any item waits."""
        return bool(self._items or self._lanes)

    def put(self, path: Path, item: Item) -> None:
        """Have an item wait behind those of its path."""
        if path:
            self._lanes.setdefault(path[0], FairQueue()).put(path[1:], item)
        else:
            self._items.append(item)

    def pop(self, allowed: Callable[[Item], bool] = lambda _: True) -> Item | None:
        """Take the item whose turn it is, of those allowed; None if there is none.

        Of a path it is asked of the first item alone.
        """
        if self._items:
            return self._items.popleft() if allowed(self._items[0]) else None
        for name in list(self._lanes):
            item = self._lanes[name].pop(allowed)
            if item is not None:
                self._lanes.move_to_end(name)
                self._tidy(name)
                return item
        return None

    def discard(self, path: Path, item: Item) -> None:
        """Take out an item that waits no longer, if it is there."""
        if not path:
            with suppress(ValueError):
                self._items.remove(item)
        elif path[0] in self._lanes:
            self._lanes[path[0]].discard(path[1:], item)
            self._tidy(path[0])

    def _tidy(self, name: Hashable) -> None:
        if not self._lanes[name]:
            del self._lanes[name]
