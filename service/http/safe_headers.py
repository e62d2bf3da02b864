"""What every answer forbids browsers to do with it; pages allow themselves what they need.

In one place, outside of all else: answers of errors, of refusals and of files have it, too.
"""

from collections.abc import Iterable

from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY = b"content-security-policy"
HEADERS = {
    # Nothing of an answer is run or loaded, and no page shows it in a frame of its own.
    POLICY: b"default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    b"x-frame-options": b"DENY",  # for browsers that do not know frame-ancestors
    b"x-content-type-options": b"nosniff",  # a capture is no script, whatever its bytes look like
    b"referrer-policy": b"no-referrer",
    # Pages of other origins neither embed it nor hold on to a window of ours. Scripts of those that
    # FEWVIEW_CORS_ORIGINS allows can read it all the same.
    b"cross-origin-resource-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
}
ANSWERS = ("http.response.start", "websocket.http.response.start")

RawHeaders = Iterable[tuple[bytes, bytes]]


def made_safe(headers: RawHeaders) -> list[tuple[bytes, bytes]]:
    """Return headers of an answer, and of the above those that are not among them."""
    given = list(headers)
    names = {name.lower() for name, _ in given}
    return [*given, *((name, value) for name, value in HEADERS.items() if name not in names)]


class SafeHeaders:
    """Makes the headers of every answer safe."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def send_safely(message: Message) -> None:
            if message["type"] in ANSWERS:
                message["headers"] = made_safe(message.get("headers", ()))
            await send(message)

        await self._app(scope, receive, send_safely)
