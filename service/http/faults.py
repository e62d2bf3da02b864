"""Faults of ours, answered before the answer has left the middleware."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.http.errors import of_bug


class Faults:
    """Answers an unforeseen exception, and raises it again for the log.

    Starlette does so outside of all middleware, where the answer lacks the headers without which a
    web page's script cannot read it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        begun = scope["type"] != "http"

        async def watched(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            if not begun:
                await of_bug(error).response()(scope, receive, send)
            raise
