"""The limits on request bodies, held while they stream in."""

import asyncio

from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.errors import PROBLEMS, ApiError
from service.http.places import is_shared, refused, who_asks
from store.shares import Shares, Who

SMALL_BYTES = 64 * 1024  # what a request takes at least, and what bodies may grow to in the reserve
RESERVE = 4  # one part in so many is kept for small bodies: large ones cannot lock them out
RETRY_SECONDS = "1"
SLOWEST = 1024  # bytes a second


class _InHand:
    """What one body takes of the bytes in hand, in the shares of its key and project.

    A small body counts among the small ones alone, so a key whose share large ones have used up can
    still send those.
    """

    def __init__(self, bytes_in_hand: Shares, connection: HTTPConnection) -> None:
        self._shares, self._connection = bytes_in_hand, connection
        self._account: Who | None = None
        self._taken, self._shared = 0, False

    def grow(self, came: int) -> None:
        """Take what is needed for a body of which so much came.

        Raises
        ------
        ApiError
            429 or 503 if there is not as much.
        """
        size, large = max(came, SMALL_BYTES), came > SMALL_BYTES
        needed = size - self._taken
        if not needed:
            return
        if self._account is None or large > (self._taken > SMALL_BYTES):
            self._move(large=large)
        account, shared = self._account, self._shared
        assert account is not None  # noqa: S101
        if shared:
            allowed = self._shares.may_take(account, needed)
        else:
            reserve = self._shares.whole // RESERVE if large else 0
            allowed = needed <= self._shares.free - reserve
        if not allowed:
            raise refused(
                self._shares,
                account,
                shared=shared,
                whole="The requests in hand fill the memory set aside for them; try again "
                f"in {RETRY_SECONDS} s.",
                retry_seconds=RETRY_SECONDS,
            )
        self._shares.take(account, needed)
        self._taken = size

    def _move(self, *, large: bool) -> None:
        """Count what the body has among the large ones, or the small ones."""
        who, taken = who_asks(self._connection), self._taken
        self.end()
        self._account = who if large else Who(f"small of {who.project}", who.key_id)
        self._shares.take(self._account, taken)
        self._taken, self._shared = taken, is_shared(self._connection)

    def end(self) -> None:
        """Give back all that the body has."""
        if self._account is not None:
            self._shares.give_back(self._account, self._taken)
        self._account, self._taken = None, 0


class BodyLimit:
    """Refuses a body that is too long or slow, and any body while those in hand fill the memory.

    A body with a declared length is refused before it is read, any other as soon as it is too long.
    FastAPI's own ``max_body_size`` would answer in plain text, whatever the error handlers. A body
    whose client falls silent, or sends less than a KiB a second, is given up.
    """

    def __init__(
        self, app: ASGIApp, max_bytes: int, max_pending_bytes: int, seconds: float
    ) -> None:
        self._app, self._max_bytes, self._seconds = app, max_bytes, seconds
        self._bytes_in_hand = Shares(max_pending_bytes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        detail = (
            f"Bodies may have {self._max_bytes} bytes at most. Send the frames in parts: "
            "POST /datasets/{id}/frames."
        )
        length = next((value for name, value in scope["headers"] if name == b"content-length"), 0)
        if int(length) > self._max_bytes:
            await ApiError("body_too_large", detail).response()(scope, receive, send)
            return
        came = 0
        in_hand = _InHand(self._bytes_in_hand, HTTPConnection(scope))
        pace = _Pace(receive, self._seconds)

        async def counted() -> Message:
            nonlocal came
            message = await pace.receive()
            size = len(message.get("body", b""))
            if size:
                came += size
                if came > self._max_bytes:
                    raise HTTPException(413, detail)  # of this type, to pass through FastAPI
                try:
                    in_hand.grow(came)
                except ApiError as error:  # of this type, as above
                    status, _ = PROBLEMS[error.code]
                    raise HTTPException(status, error.detail, error.headers) from error
            return message

        try:
            await self._app(scope, counted, send)
        finally:
            in_hand.end()


class _Pace:
    """Waits for a body as long as it comes at the least pace: so many bytes in so many seconds."""

    def __init__(self, receive: Receive, seconds: float) -> None:
        self._receive, self._seconds = receive, seconds
        self._left, self._came, self._whole = seconds, 0, False

    async def receive(self) -> Message:
        """Return what comes next; raise ``HTTPException`` 408 if that takes too long."""
        if self._whole:
            return await self._receive()
        now = asyncio.get_running_loop().time
        began = now()
        try:
            async with asyncio.timeout(self._left):
                message = await self._receive()
        except TimeoutError:
            raise HTTPException(
                408, f"expected {SLOWEST} bytes of the body a second, over {self._seconds:g} s each"
            ) from None
        self._left -= now() - began
        self._came += len(message.get("body", b""))
        if self._came >= SLOWEST * self._seconds:
            self._left, self._came = self._seconds, 0
        self._whole = not message.get("more_body", False)
        return message
