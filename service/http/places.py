"""Places that clients have: a few at a time, in shares of projects and keys (`store.shares`).

Who asks for a place that may be held for long is refused at once where there is none (`Places`), as
every request is that comes while too many are in hand (`InHand`); who has work that takes a moment
waits for a turn (`Turns`).
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager
from typing import NamedTuple, TypeVar

from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.errors import ApiError
from service.http.fair_queue import FairQueue
from service.http.keyring import Caller, Keyring
from store.shares import NO_KEY, Shares, Who

LONGEST_WAIT = 10.0  # seconds
RETRY_SECONDS = "5"
STRANGERS = Who("", NO_KEY)  # who asks for what needs no key: no project has this name

Result = TypeVar("Result")


def who_asks(connection: HTTPConnection) -> Who:
    """Return whose share a request takes from."""
    caller: Caller | None = connection.scope["state"].get("caller")
    if caller is None:
        return STRANGERS
    return Who(caller.author.project, caller.author.key_id)


def is_shared(connection: HTTPConnection) -> bool:
    """Return whether there are others, who may come at any time: keys that are in force.

    To who comes without a key, to ask how the service is or for the page, there always are.
    """
    if "caller" not in connection.scope["state"]:
        return True
    keyring: Keyring = connection.app.state.keyring
    return keyring.is_shared


def refused(shares: Shares, who: Who, *, shared: bool, whole: str, retry_seconds: str) -> ApiError:
    """Return why somebody gets no more: the own share is used up, or the whole is.

    Parameters
    ----------
    whole
        What the error is called where the whole is used up, as a sentence.
    """
    headers = {"Retry-After": retry_seconds}
    if shared and (shares.free or shares.has_its_share(who)):
        return ApiError(
            "share_exhausted",
            f"This key, or its project, has its share of {shares.whole} that all have together: "
            "try again when some of its own have ended.",
            headers=headers,
        )
    return ApiError("overloaded", whole, headers=headers)


class Places:
    """Places that may be held for long. One more is refused at once."""

    def __init__(self, count: int) -> None:
        self._shares = Shares(count)

    def refusal(self, connection: HTTPConnection, whole: str) -> ApiError | None:
        """Return why a client gets no place, if it gets none: `whole` where all are taken."""
        who, shared = who_asks(connection), is_shared(connection)
        if self._shares.may_take(who) if shared else self._shares.free:
            return None
        return refused(self._shares, who, shared=shared, whole=whole, retry_seconds="10")

    @contextmanager
    def held(self, connection: HTTPConnection) -> Iterator[None]:
        """Hold a place, which was not refused just now."""
        who = self.take(connection)
        try:
            yield
        finally:
            self.give_back(who)

    def take(self, connection: HTTPConnection) -> Who:
        """Take a place, which was not refused just now; return whose it is, to give it back."""
        who = who_asks(connection)
        self._shares.take(who)
        return who

    def give_back(self, who: Who) -> None:
        """Give a place back."""
        self._shares.give_back(who)


class InHand:
    """Refuses a request while those in hand have all places, or their key's or project's share.

    A request holds its place from its head to the end of its answer, however slowly its body comes
    or its answer is read.
    """

    def __init__(self, app: ASGIApp, most: int) -> None:
        self._app, self._places = app, Places(most)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        refusal = self._places.refusal(connection, "As many requests are in hand as may be.")
        if refusal is not None:
            await refusal.response()(scope, receive, send)
            return
        who = self._places.take(connection)
        try:
            await self._app(scope, receive, send)
        finally:
            self._places.give_back(who)


class _Waiting(NamedTuple):
    who: Who
    shared: bool
    turn: "asyncio.Future[None]"


class Turns:
    """Turns at work: a few have one at a time, and projects take turns in waiting for them.

    Parameters
    ----------
    count
        Those at a time.
    reserving
        Whether no key gets so many that none is left for others: for work that takes longer than
        others would wait.
    """

    def __init__(self, count: int, *, reserving: bool = False) -> None:
        self._shares, self._reserving = Shares(count), reserving
        self._waiting: FairQueue[_Waiting] = FairQueue()

    @asynccontextmanager
    async def turn(
        self, connection: HTTPConnection, *, patient: bool = False
    ) -> AsyncIterator[None]:
        """Wait for a turn, and have it; `patient`: however long that takes.

        Raises
        ------
        ApiError
            429 or 503 if there was none within `LONGEST_WAIT`.
        """
        one = _Waiting(
            who_asks(connection), is_shared(connection), asyncio.get_running_loop().create_future()
        )
        if self._may_begin(one):
            self._shares.take(one.who)
        else:
            await self._wait(one, None if patient else LONGEST_WAIT)
        try:
            yield
        finally:
            self._end(one.who)

    def _may_begin(self, one: _Waiting) -> bool:
        if self._reserving and one.shared:
            return self._shares.may_take(one.who)
        return self._shares.free > 0

    async def _wait(self, one: _Waiting, patience: float | None) -> None:
        self._waiting.put(one.who, one)
        try:
            async with asyncio.timeout(patience):
                await one.turn
        except BaseException as error:
            if one.turn.done() and not one.turn.cancelled():
                self._end(one.who)  # it came at the same moment
            else:
                self._waiting.discard(one.who, one)
            if not isinstance(error, TimeoutError):
                raise
            raise refused(
                self._shares,
                one.who,
                shared=one.shared,
                whole=f"Those that came before have taken all places for {patience:g} s; try again "
                f"in {RETRY_SECONDS} s.",
                retry_seconds=RETRY_SECONDS,
            ) from None

    def _end(self, who: Who) -> None:
        self._shares.give_back(who)
        while (one := self._waiting.pop(self._may_begin)) is not None:
            if not one.turn.done():
                self._shares.take(one.who)
                one.turn.set_result(None)


class Threads:
    """Threads for work that is no other's to wait for, in turns of projects and keys."""

    def __init__(self, count: int, name: str) -> None:
        self._turns = Turns(count)
        self._executor = ThreadPoolExecutor(count, thread_name_prefix=name)

    async def run(
        self, connection: HTTPConnection, work: Callable[..., Result], *arguments: object
    ) -> Result:
        """Do work in a thread; wait for one as long as it takes."""
        async with self._turns.turn(connection, patient=True):
            run = asyncio.get_running_loop().run_in_executor
            return await run(self._executor, work, *arguments)

    def close(self) -> None:
        """Begin nothing more."""
        self._executor.shutdown(wait=False, cancel_futures=True)
