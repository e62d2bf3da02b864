"""Who may do what: the keys in force, in the memory of each process of the API."""

import logging
import threading
import time
from collections.abc import Mapping
from typing import NamedTuple

from starlette.requests import HTTPConnection

from service.settings import Settings
from store import access_keys, access_token
from store.access_keys import SCOPES, Scope
from store.authors import Author
from store.database import Store
from store.quotas import Quotas
from store.records import AccessKey

logger = logging.getLogger(__name__)

LOOK_SECONDS = 0.5  # between two looks at the records: a key is in force, or refused, that late


class Caller(NamedTuple):
    """Who sent a request.

    Attributes
    ----------
    author
        On whose behalf the store is used.
    scopes
        What the caller may do.
    expires_at
        Until when, in seconds since the epoch; None: for good.
    """

    author: Author
    scopes: frozenset[Scope]
    expires_at: float | None = None


ANYBODY = Caller(Author(key_id="anybody"), frozenset())
OWNER = Caller(Author(), frozenset(SCOPES))  # the user that the service runs as


class Keyring:
    """The keys in force. A thread reads the records twice a second; nobody waits for it.

    While the records cannot be read, the keys that were in force stay so.
    """

    def __init__(self, store: Store, fixed: Mapping[str, Caller]) -> None:
        """Read the keys.

        Parameters
        ----------
        fixed
            Callers whose tokens are not in the records, by the digests of these.
        """
        self._store, self._fixed = store, fixed
        self._callers = self._read()
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="keyring", daemon=True)
        self._watcher.start()

    def close(self) -> None:
        """Read the records no more."""
        self._closed.set()
        self._watcher.join(LOOK_SECONDS)

    def find(self, token: str) -> Caller | None:
        """Return who has a token; None if no key in force has it. It waits for nothing."""
        caller = self._callers.get(access_keys.digest(token))
        if caller is None or (caller.expires_at is not None and caller.expires_at <= time.time()):
            return None
        return caller

    def look(self) -> None:
        """Read the keys now, after a change that this process has made."""
        self._callers = self._read()

    def _read(self) -> dict[str, Caller]:
        return {
            **{key.digest: _caller(key) for key in access_keys.in_force(self._store)},
            **self._fixed,
        }

    def _watch(self) -> None:
        blind = False
        while not self._closed.wait(LOOK_SECONDS):
            try:
                self.look()
                blind = False
            except Exception:  # whatever it is: it must not end the watch
                if not blind:
                    logger.exception("Cannot read which keys are in force: they stay as they were")
                blind = True


def caller_of(connection: HTTPConnection) -> Caller:
    """Return who sent a request."""
    caller: Caller = connection.scope["state"]["caller"]
    return caller


def fixed_callers(settings: Settings) -> dict[str, Caller]:
    """Return who comes with a token that is in the settings or in the data folder."""
    callers = {}
    if settings.admin_key is not None:
        admin = OWNER._replace(author=Author(key_id="admin"))
        callers[access_keys.digest(settings.admin_key)] = admin
    if (settings.data_dir / access_token.NAME).exists():
        callers[access_keys.digest(access_token.ensure(settings.data_dir))] = OWNER
    return callers


def _caller(key: AccessKey) -> Caller:
    author = Author(key.project, key.id, Quotas.model_validate(key.quotas or {}))
    return Caller(author, frozenset(key.scopes), key.expires_at)
