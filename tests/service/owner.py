"""A client inside the process of the API, which takes it for its own user."""

from typing import Any

from starlette.testclient import TestClient


class _Peer:
    trusted = True


class OwnersClient(TestClient):
    """Needs no key, as whoever connects from this machine as the user of the service."""

    def __init__(self, app: Any, base_url: str = "http://127.0.0.1", **more: Any) -> None:
        super().__init__(app, base_url, **more)
        self.app_state["peer"] = _Peer()  # as service.http.connections does for a connection

    def websocket_connect(self, url: str, *arguments: Any, **more: Any) -> Any:
        """Open a WebSocket at the same address; Starlette's own client has a name for it."""
        return super().websocket_connect(f"ws://127.0.0.1{url}", *arguments, **more)
