"""The limits on request bodies, held while they stream in."""

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.errors import ApiError

SMALL_BYTES = 64 * 1024  # what a request takes at least, and what bodies may grow to in the reserve
RESERVE = 4  # one part in so many is kept for small bodies: large ones cannot lock them out
RETRY_SECONDS = "1"


class BodyLimit:
    """Refuses a body that is too long, and any while those in hand fill the room for them.

    One that says how long it is is refused before it is read, any other as soon as it is too long.
    FastAPI's own ``max_body_size`` answers in plain text, whatever the error handlers.
    """

    def __init__(self, app: ASGIApp, max_bytes: int, max_pending_bytes: int) -> None:
        self._app, self._max_bytes, self._room = app, max_bytes, max_pending_bytes
        self._reserve = max_pending_bytes // RESERVE

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

        async def counted() -> Message:
            nonlocal came, taken
            message = await receive()
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
