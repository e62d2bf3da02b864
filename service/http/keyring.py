"""Who may do what: the keys in force, in the memory of each process of the API."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from typing import Any, NamedTuple

from starlette.requests import HTTPConnection

from service.http.errors import ApiError
from service.settings import Settings
from store import access_keys, access_token
from store.access_keys import SCOPES, Scope
from store.authors import Author
from store.database import Store
from store.quotas import Quotas
from store.records import AccessKey

logger = logging.getLogger(__name__)

LOOK_SECONDS = 0.5  # between two looks at the records: a key is in force, or refused, that late
ASK_SECONDS = 0.25  # between two looks at whether the key of an open connection still is


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
    digest
        Of the token of a key that may be revoked; None for any other caller.
    """

    author: Author
    scopes: frozenset[Scope]
    expires_at: float | None = None
    digest: str | None = None


OWNER = Caller(Author(), frozenset(SCOPES))  # the user that the service runs as


class Keyring:
    """The valid keys. A thread reads the records twice a second; no request waits for it.

    While the records cannot be read, the keys that were valid stay so.
    """

    def __init__(self, store: Store, fixed: Mapping[str, Caller]) -> None:
        """Read the keys.

        Parameters
        ----------
        fixed
            Callers whose tokens are not in the records, by the digests of these.
        """
        self._store, self._fixed = store, fixed
        self._reading = threading.Lock()  # what was read last is kept, not what was read first
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
        return self._find(access_keys.digest(token))

    @property
    def is_shared(self) -> bool:
        """Whether any key is in force: then others than the service's own user may come."""
        return len(self._callers) > len(self._fixed)

    def is_in_force(self, caller: Caller) -> bool:
        """Return whether a caller's key is still valid, without waiting."""
        return caller.digest is None or self._find(caller.digest) is not None

    def _find(self, digest: str) -> Caller | None:
        caller = self._callers.get(digest)
        if caller is None or (caller.expires_at is not None and caller.expires_at <= time.time()):
            return None
        return caller

    def look(self) -> None:
        """Read the keys now, after a change that this process has made."""
        with self._reading:
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


def still_let_in(connection: HTTPConnection) -> Callable[[], bool]:
    """Return a function that checks whether the key of a request is still valid."""
    keyring: Keyring = connection.app.state.keyring
    return partial(keyring.is_in_force, caller_of(connection))


async def while_let_in(connection: HTTPConnection, work: Coroutine[Any, Any, None]) -> None:
    """Do work for a connection as long as its key is in force, whether the work waits or not.

    Raises
    ------
    ApiError
        401 once the key is not; and whatever the work raises.
    """
    in_force = still_let_in(connection)

    async def watch() -> None:
        while in_force():  # noqa: ASYNC110 (a key that expires sets no event)
            await asyncio.sleep(ASK_SECONDS)
        raise ApiError("unauthorized", "This key was revoked or has expired.")

    try:
        async with asyncio.TaskGroup() as tasks:
            watching = tasks.create_task(watch())
            await work
            watching.cancel()
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


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
    return Caller(author, frozenset(key.scopes), key.expires_at, key.digest)
