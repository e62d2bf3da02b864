"""The limit on request bodies, held while they stream in."""

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import ApiError


class BodyLimit:
    """Refuses a body that says it is too long before reading it, any other as soon as it is.

    FastAPI's own ``max_body_size`` answers the former in plain text, whatever the error handlers.
    """

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self._app, self._max_bytes = app, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        detail = (
            f"Bodies may have {self._max_bytes} bytes at most. Send the frames in parts: "
            "POST /datasets/{id}/frames."
        )
        if int(Headers(scope=scope).get("content-length", 0)) > self._max_bytes:
            await ApiError("body_too_large", detail).response()(scope, receive, send)
            return
        came = 0

        async def counted() -> Message:
            nonlocal came
            message = await receive()
            came += len(message.get("body", b""))
            if came > self._max_bytes:
                raise HTTPException(413, detail)  # of this type, to pass through FastAPI
            return message

        await self._app(scope, counted, send)
