"""The names under which the service answers: a web page reaches it under no other."""

from functools import lru_cache

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.errors import ApiError
from service.settings import WILDCARDS, Settings, is_address, is_loopback


class Hosts:
    """Refuses requests, and handshakes of WebSockets, whose ``Host`` names another place.

    The owner of a name can point it to this machine after a browser has loaded a page from it (DNS
    rebinding). The browser then treats the service as part of that page, but still sends the host
    of that page. Addresses need not be allowed by name: loopback, the address listened on and, if
    that is all addresses, any address.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._listens_on = app, settings.host.lower()
        self._allowed = [name.lower() for name in settings.allowed_names]
        self._is_ours = lru_cache(maxsize=256)(self._decide)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] in ("http", "websocket"):
            host = Headers(scope=scope).get("host", "")
            if not self._is_ours(host):
                error = ApiError(
                    "host_not_allowed",
                    f"The service is not known as {host!r:.200}; list the names under "
                    "which it is reached in FEWVIEW_ALLOWED_HOSTS.",
                )
                await error.response()(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _decide(self, host: str) -> bool:
        if "*" in self._allowed:
            return True
        name = without_port(host.lower())
        return (
            is_loopback(name)
            or name in (self._listens_on, *self._allowed)
            or (self._listens_on in WILDCARDS and is_address(name))
        )


def without_port(host: str) -> str:
    """Return the name or the address that a ``Host`` has."""
    name, colon, port = host.rpartition(":")
    name = name if colon and (port.isdigit() or not port) and not host.endswith("]") else host
    return name.removeprefix("[").removesuffix("]")
