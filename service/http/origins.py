"""Scripts of other web pages, which browsers let send what nobody allowed them to."""

from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from service.http.errors import ApiError
from service.settings import Settings


def refuse_foreign(connection: HTTPConnection) -> None:
    """Refuse a request of a web page that is neither the service's own nor of an allowed origin.

    Before a script opens a WebSocket, or posts a form, browsers ask nobody, but they name its
    origin; other clients name none.

    Raises
    ------
    ApiError
        403 that says how to allow it.
    """
    origin = connection.headers.get("origin")
    if origin is None or _host(origin) == connection.headers.get("host"):
        return
    settings: Settings = connection.app.state.settings
    if not {"*", origin} & {*settings.allowed_origins}:
        raise ApiError(
            "origin_not_allowed",
            f"Scripts of {origin!r:.200} may not do this here; FEWVIEW_CORS_ORIGINS tells the "
            "origins that may.",
        )


def _host(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None
