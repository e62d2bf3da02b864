"""Refusing scripts of other web pages, from which browsers send requests without permission."""

from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection

from service.http.errors import ApiError
from service.settings import Settings


def refuse_foreign(connection: HTTPConnection) -> None:
    """Refuse a request of a web page that is neither the service's own nor of an allowed origin.

    Browsers open a WebSocket or post a form for a script without asking the server first, but they
    send its origin; other clients send none.

    Raises
    ------
    ApiError
        403, with how to allow it.
    """
    if is_own(connection.headers):
        return
    origin = connection.headers["origin"]
    settings: Settings = connection.app.state.settings
    if not {"*", origin} & {*settings.allowed_origins}:
        raise ApiError(
            "origin_not_allowed",
            f"Scripts of {origin!r:.200} may not do this here; list allowed origins in "
            "FEWVIEW_CORS_ORIGINS.",
        )


def is_own(headers: Headers) -> bool:
    """Return whether no page sends it, or one that came from the service itself."""
    origin = headers.get("origin")
    return origin is None or _host(origin) == headers.get("host")


def _host(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
