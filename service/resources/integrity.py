"""Whether the records are damaged, looked for beside the requests that ask."""

import logging
import threading
import time

from sqlalchemy.exc import SQLAlchemyError

from store.database import Store
from store.integrity import find_damage

logger = logging.getLogger(__name__)

LOOK_SECONDS = 20.0  # a look that takes longer is given up: `fewview doctor` has more time
SHARE = 20  # a look is followed by so many times its length without another,
PAUSE_SECONDS = 5.0  # and by so much at least
PATIENCE_SECONDS = 0.1  # that who asks waits for a look: small records are looked through by then


class Integrity:
    """The result of the last check of the records; asking for it starts another one when due.

    A check reads all of the records. So it runs in a separate thread, in one process at a time, for
    at most a twentieth of the time.
    """

    def __init__(self, store: Store) -> None:
        self._store, self._lock = store, threading.Lock()
        self._found: str | None = None
        self._done, self._next = threading.Event(), 0.0
        self._done.set()

    def damage(self) -> str | None:
        """Return what is wrong with the records, as far as is known."""
        with self._lock:
            if self._done.is_set() and time.monotonic() >= self._next:
                self._done.clear()
                threading.Thread(target=self._look, daemon=True).start()
        self._done.wait(PATIENCE_SECONDS)
        return self._found

    def _look(self) -> None:
        began = time.monotonic()
        try:
            found = find_damage(self._store.engine, seconds=LOOK_SECONDS)
            if found != self._found:
                logger.error("The records are damaged: %s", found or "no longer")
            self._found = found
        except (TimeoutError, SQLAlchemyError) as error:  # other checks report this
            logger.info("The records were not looked through: %s", error)
        finally:
            now = time.monotonic()
            self._next = now + max(PAUSE_SECONDS, SHARE * (now - began))
            self._done.set()
