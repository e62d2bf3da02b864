"""HEAD: what GET would answer, without the body."""

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class _HeadersAreOut(Exception):  # noqa: N818 (no error: there is nothing more to do)
    pass


class Head:
    """Answers HEAD wherever there is a GET, which is left as soon as its headers are out.

    So neither a stream of events nor a large result is made in vain. ``Range`` is of GET alone
    (RFC 9110).
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        headers = [item for item in scope["headers"] if item[0] != b"range"]

        async def send_headers(message: Message) -> None:
            await send(message)
            await send({"type": "http.response.body"})
            raise _HeadersAreOut

        get = {**scope, "method": "GET", "headers": headers}
        try:
            await self._app(get, receive, send_headers)
        except* _HeadersAreOut:
            pass
        finally:
            scope["route"] = get.get("route")  # for who counts requests
