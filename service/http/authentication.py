"""Who sends a request, and whether the key allows it: asked before anything else is done."""

from collections.abc import Iterable
from typing import cast

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from service.http.errors import ApiError
from service.http.key_rates import Rates
from service.http.keyring import OWNER, Caller, Keyring
from service.http.local_owner import LocalOwner
from service.settings import Settings, is_loopback
from store import access_keys

PROBES = ("/health/live", "/health/ready")  # which balancers ask without a key
PAGE_FILES = "/page"  # below it lies what the page at / is made of
DOCUMENTATION = "/docs"  # of the API, with what it is made of below
DOCUMENT = "/openapi.json"
SUBPROTOCOL = "fewview"  # of a WebSocket whose client names its key in another subprotocol
BEARER_SUBPROTOCOL = "bearer."
HOW = (
    "Send the header `Authorization: Bearer TOKEN`. Who keeps the service makes keys with "
    "`fewview key create`."
)
OF_PAGE = (
    "A browser on the service's own computer needs the address of the page that `fewview serve` "
    "printed; `fewview open` opens it."
)
# The first part of a path, or its first two: what its routes need, whatever the method.
OF_PATH: dict[str, access_keys.Scope] = {
    "lift/streams": "read",  # which others have opened
    "keys": "admin",
    "audit": "admin",
    "webhooks": "webhook",
    "lift": "lift",
    "evaluations": "read",  # which are calculated and not stored
}


class Authentication:
    """Refuses requests, and handshakes of WebSockets, without a key that allows them.

    The caller is in ``scope["state"]["caller"]``. Without a key only the owner is let in, who
    connects from this machine as the user that the service runs as, or as root.
    """

    def __init__(self, app: ASGIApp, settings: Settings, owner: LocalOwner) -> None:
        self._app, self._owner = app, owner
        closed = is_loopback(settings.host) and settings.trust_local
        self._probes = () if closed else PROBES

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] in ("http", "websocket") and not self._needs_no_key(scope):
            try:
                caller = await self._let_in(scope)
            except ApiError as error:
                await error.response()(scope, receive, send)
                return
            scope.setdefault("state", {})["caller"] = caller
        await self._app(scope, receive, send)

    def _needs_no_key(self, scope: Scope) -> bool:
        return scope["path"] in self._probes or _is_of_page(scope)

    async def _let_in(self, scope: Scope) -> Caller:
        """Return who sends a request that is allowed; raise ``ApiError`` for any other."""
        caller = self._identify(scope)
        for each in needed(scope.get("method", "GET"), scope["path"]):
            _check_scope(caller, each)
        if caller.author.quotas.requests_per_second is not None:
            rates: Rates = scope["app"].state.rates
            await rates.take_request(caller)
        return caller

    def _identify(self, scope: Scope) -> Caller:
        """Return the caller of a request; raise ``ApiError`` 401 if it is unknown."""
        token = _token_in(scope)
        if self._owner.sends(scope, token):
            return OWNER
        if token is None:
            if _is_documentation(scope) and self._owner.connects(scope):
                return OWNER  # a browser's, too: there is no user's data in it
            raise _unauthorized(f"This needs a key. {HOW} {OF_PAGE}")
        keyring: Keyring = scope["app"].state.keyring
        caller = keyring.find(token)
        if caller is None:
            raise _unauthorized("This key is unknown, expired or revoked.", "invalid_token")
        return caller


def needed(method: str, path: str) -> tuple[access_keys.Scope, ...]:
    """Return the scopes that a request needs; of a WebSocket the method is GET.

    What answers with something that was stored before needs `read`, too: changes of a record, and
    deleting all that a query finds, which counts them.
    """
    first, _, more = path.lstrip("/").partition("/")
    for begin in (f"{first}/{more.partition('/')[0]}", first):
        if begin in OF_PATH:
            return (OF_PATH[begin],)
    if method in ("GET", "HEAD", "OPTIONS"):
        return ("read",)
    if method == "DELETE":
        return ("delete",) if more else ("delete", "read")
    return ("write", "read") if more else ("write",)


def _is_of_page(scope: Scope) -> bool:
    """Whether a request is for the page, which asks for a key itself and has no user's data."""
    path, reads = scope["path"], scope.get("method") in ("GET", "HEAD")
    return reads and (path == "/" or path.startswith(f"{PAGE_FILES}/"))


def _is_documentation(scope: Scope) -> bool:
    path, reads = scope["path"], scope.get("method") in ("GET", "HEAD")
    return reads and (path in (DOCUMENT, DOCUMENTATION) or path.startswith(f"{DOCUMENTATION}/"))


def subprotocol_of(connection: HTTPConnection) -> str | None:
    """Return the subprotocol to accept a WebSocket with, if its client offers ours."""
    offered = _offered(connection.headers)
    return SUBPROTOCOL if SUBPROTOCOL in offered else None


def _token_in(scope: Scope) -> str | None:
    """Return the token that a request carries, if any; raise ``ApiError`` for another scheme."""
    for name, value in scope["headers"]:
        if name == b"authorization":
            scheme, _, token = value.decode("latin-1").partition(" ")
            if scheme.lower() != "bearer" or not token.strip():
                raise _unauthorized(f"expected a key as a bearer token. {HOW}", "invalid_request")
            return cast(str, token.strip())
    if scope["type"] == "websocket":
        for offer in _offered(Headers(scope=scope)):
            if offer.startswith(BEARER_SUBPROTOCOL):
                return offer.removeprefix(BEARER_SUBPROTOCOL)
    return None


def _offered(headers: Headers) -> Iterable[str]:
    """Return the subprotocols that the client of a WebSocket offers."""
    lines = headers.getlist("sec-websocket-protocol")
    return [offer.strip() for line in lines for offer in line.split(",")]


def _check_scope(caller: Caller, scope: access_keys.Scope) -> None:
    if scope not in caller.scopes:
        may = ", ".join(name for name in access_keys.SCOPES if name in caller.scopes)
        raise ApiError(
            "forbidden",
            f"This needs a key with the scope {scope}; this one has {may or 'none'}.",
            headers={"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{scope}"'},
        )


def _unauthorized(detail: str, error: str | None = None) -> ApiError:
    challenge = 'Bearer realm="fewview"' + (f', error="{error}"' if error else "")
    return ApiError("unauthorized", detail, headers={"WWW-Authenticate": challenge})
