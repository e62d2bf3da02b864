"""How the server shuts down: it reports this, finishes the requests in hand, and then closes."""

import asyncio
import socket

import uvicorn
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

CLOSE_SECONDS = 3  # after which requests that were not finished in time are cancelled


class Server(uvicorn.Server):
    """Serves until SIGTERM, at which uvicorn alone would close its sockets at once.

    From then on ``leaving`` is set, and WebSockets are closed with 1012 ("service restart" in
    IANA's registry). Requests are still answered: for ``drain_seconds``, until load balancers that
    check readiness send no more, and then until none is in hand, for up to ``grace_seconds``.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        leaving: asyncio.Event,
        *,
        drain_seconds: float,
        grace_seconds: float,
    ) -> None:
        super().__init__(config)
        self._leaving, self._drain, self._grace = leaving, drain_seconds, grace_seconds

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Leave."""
        self._leaving.set()
        for connection in list(self.server_state.connections):
            if isinstance(connection, WebSocketsSansIOProtocol):
                connection.shutdown()
        await self._wait(self._drain)
        await self._wait(self._grace, until_idle=True)
        await super().shutdown(sockets)

    async def _wait(self, seconds: float, *, until_idle: bool = False) -> None:
        deadline = asyncio.get_running_loop().time() + seconds
        while asyncio.get_running_loop().time() < deadline and not self.force_exit:
            if until_idle and not self.server_state.tasks:
                return
            await asyncio.sleep(0.05)
