"""Delivers what webhooks are to get: signed, as Standard Webhooks has it, to public addresses."""

import asyncio
import logging
import socket
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import version
from typing import NamedTuple

import httpcore2
from standardwebhooks import Webhook

from store import webhooks
from store.database import Store
from store.webhooks import Due
from worker.addresses import is_public
from worker.settings import WorkerSettings

logger = logging.getLogger(__name__)

AT_A_TIME = 20  # attempts, beside each other
LOOK_SECONDS = 0.5  # at what became due while attempts go on
ATTEMPT_SECONDS = 15.0  # in all, from the name's address to the status of the answer


class _Outcome(NamedTuple):
    delivered: bool
    words: str


class _PrivateError(Exception):
    """A name resolves to an address to which no message may be sent."""


def deliver(settings: WorkerSettings) -> None:
    """Attempt all deliveries that are due, in a process that is forked for that."""
    store = Store(settings)
    asyncio.run(_attempt_all(store, private=settings.webhook_private_targets))
    store.close()


async def _attempt_all(store: Store, *, private: bool) -> None:
    """Attempt deliveries beside each other, until none is due; ``private`` allows any address."""
    running: dict[asyncio.Task[_Outcome], Due] = {}
    async with httpcore2.AsyncConnectionPool(
        ssl_context=ssl.create_default_context(),
        max_connections=AT_A_TIME,
        max_keepalive_connections=0,
        network_backend=_Network(private=private),
    ) as connections:
        while True:
            for due in webhooks.take_due(store, running.values(), AT_A_TIME):
                running[asyncio.create_task(_attempt(connections, due))] = due
            if not running:
                return
            ended, _ = await asyncio.wait(
                running, timeout=LOOK_SECONDS, return_when=asyncio.FIRST_COMPLETED
            )
            for task in ended:
                due, outcome = running.pop(task), task.result()
                webhooks.finish(store, due, outcome.words, delivered=outcome.delivered)
                logger.info("%s, attempt %d: %s", due.id, due.attempt, outcome.words)


async def _attempt(connections: httpcore2.AsyncConnectionPool, due: Due) -> _Outcome:
    """Send a message. Only 2xx is a success: redirections are not followed."""
    try:
        async with (
            asyncio.timeout(ATTEMPT_SECONDS),
            connections.stream(
                "POST", due.url, headers=_headers(due), content=due.payload.encode()
            ) as answer,
        ):
            return _Outcome(200 <= answer.status < 300, f"The answer was {answer.status}.")
    except TimeoutError:
        return _Outcome(False, f"There was no answer within {ATTEMPT_SECONDS:g} s.")
    except _PrivateError:
        return _Outcome(False, "The host's address is not public: nothing was sent.")
    except socket.gaierror:
        return _Outcome(False, "The host has no address.")
    except ssl.SSLError as error:
        return _Outcome(False, f"TLS failed: {error.reason}.")
    except Exception as error:  # a receiver of any kind ends no other's delivery
        logger.info("Delivery %s", due.id, exc_info=error)
        return _Outcome(False, f"The host cannot be reached: {type(error).__name__}.")


def _headers(due: Due) -> dict[bytes | str, bytes | str]:
    now = datetime.now(UTC)
    return {
        "Content-Type": "application/json",
        "User-Agent": f"Fewview/{version('fewview-server')}",
        "Connection": "close",
        "webhook-id": due.id,
        "webhook-timestamp": str(int(now.timestamp())),
        "webhook-signature": Webhook(due.secret).sign(due.id, now, due.payload),
    }


class _Network(httpcore2.AnyIOBackend):
    """Connects to addresses that were looked at, so that no name can change between the two."""

    def __init__(self, *, private: bool) -> None:
        super().__init__()
        self._private = private

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,  # noqa: ASYNC109 (as the base class has it)
        local_address: str | None = None,
        socket_options: Iterable[httpcore2.SOCKET_OPTION] | None = None,
    ) -> httpcore2.AsyncNetworkStream:
        """Connect to the first address of a host that answers."""
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        addresses = list(dict.fromkeys(str(info[4][0]) for info in found))
        if not self._private and not all(map(is_public, addresses)):
            raise _PrivateError
        for address in addresses[:-1]:
            try:
                return await super().connect_tcp(
                    address, port, timeout, local_address, socket_options
                )
            except httpcore2.ConnectError:
                continue
        return await super().connect_tcp(
            addresses[-1], port, timeout, local_address, socket_options
        )
