"""The one user whom the service lets in without a key: its own, by the connection.

Any program of this user may ask, and of root. Browsers are such programs, but pages of anybody have
them send requests. So of a browser more is asked: the page's key. It is new with each start of the
service and stands in the address that `fewview serve` prints. Nobody else can use it, for it holds
on connections of this user alone.
"""

import hmac
from typing import cast

from starlette.datastructures import Headers
from starlette.types import Scope

from service.http.hosts import without_port
from service.http.origins import is_own
from service.http.peers import Peer
from service.settings import Settings, is_loopback

VARIABLE = "FEWVIEW_PAGE_KEY"  # by which the processes of one start share it
FORWARDED = ("forwarded", "x-forwarded-for")
# What browsers send and scripts can neither set nor leave out; of other clients few send any.
OF_BROWSERS = ("origin", "sec-fetch-site", "sec-fetch-dest", "cookie", "referer")
BROWSERS_NAME = "mozilla/"  # of all browsers, of those too that are too old for `Sec-Fetch-*`


class LocalOwner:
    """Knows the service's own user.

    Attributes
    ----------
    page_key
        What its browsers send besides; None: nobody is let in without a key.
    """

    def __init__(self, settings: Settings, page_key: str | None) -> None:
        self.page_key = page_key if settings.trust_local else None

    def sends(self, scope: Scope, token: str | None) -> bool:
        """Return whether a request, or the handshake of a WebSocket, is this user's.

        Parameters
        ----------
        token
            The one that it carries, if any.
        """
        if self.page_key is None or not self.connects(scope):
            return False
        headers = Headers(scope=scope)
        if token is not None:
            # Of any other origin, allowed ones too, this key is no key.
            return hmac.compare_digest(token.encode(), self.page_key.encode()) and is_own(headers)
        return not is_of_browser(headers)

    def connects(self, scope: Scope) -> bool:
        """Return whether a process of this user's has connected, not through a proxy.

        And under a name that is nobody else's: what FEWVIEW_ALLOWED_HOSTS has may be of a proxy.
        """
        peer = cast(Peer | None, scope["state"].get("peer"))
        headers = Headers(scope=scope)
        if self.page_key is None or peer is None or any(name in headers for name in FORWARDED):
            return False
        return is_loopback(without_port(headers.get("host", "").lower())) and peer.trusted


def is_of_browser(headers: Headers) -> bool:
    """Return whether a request may have been sent for a web page."""
    name = headers.get("user-agent", "").lower()
    return name.startswith(BROWSERS_NAME) or any(header in headers for header in OF_BROWSERS)


def page_address(service: str, page_key: str | None) -> str:
    """Return the address of the page; what is behind ``#`` reaches no log and no proxy."""
    return service if page_key is None else f"{service}/#key={page_key}"
