"""The limits on request bodies, held while they stream in."""

import asyncio

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.errors import ApiError

SMALL_BYTES = 64 * 1024  # what a request takes at least, and what bodies may grow to in the reserve
RESERVE = 4  # one part in so many is kept for small bodies: large ones cannot lock them out
RETRY_SECONDS = "1"
SLOWEST = 1024  # bytes a second


class BodyLimit:
    """Refuses a body that is too long or slow, and any body while those in hand fill the memory.

    A body with a declared length is refused before it is read, any other as soon as it is too long.
    FastAPI's own ``max_body_size`` would answer in plain text, whatever the error handlers. A body
    whose client falls silent, or sends less than a KiB a second, is given up.
    """

    def __init__(
        self, app: ASGIApp, max_bytes: int, max_pending_bytes: int, seconds: float
    ) -> None:
        self._app, self._max_bytes, self._room = app, max_bytes, max_pending_bytes
        self._reserve, self._seconds = max_pending_bytes // RESERVE, seconds

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
        came = taken = 0
        pace = _Pace(receive, self._seconds)

        async def counted() -> Message:
            nonlocal came, taken
            message = await pace.receive()
            size = len(message.get("body", b""))
            if size:
                came += size
                if came > self._max_bytes:
                    raise HTTPException(413, detail)  # of this type, to pass through FastAPI
                needed = max(came, SMALL_BYTES) - taken
                if needed > self._room - (self._reserve if came > SMALL_BYTES else 0):
                    raise HTTPException(
                        503,
                        "The requests in hand fill the memory set aside for them; try again "
                        f"in {RETRY_SECONDS} s.",
                        {"Retry-After": RETRY_SECONDS},
                    )
                self._room -= needed
                taken += needed
            return message

        try:
            await self._app(scope, counted, send)
        finally:
            self._room += taken


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
