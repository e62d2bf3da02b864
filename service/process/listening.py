"""The sockets that the service listens on: of ``localhost`` it has both addresses, or none."""

import errno
import os
import socket
from collections.abc import Sequence

from service.settings import Settings

LONGEST_BACKLOG = 1024  # connections that wait for a process
TRIES = 20  # for a free port that both addresses have
NOT_HERE = {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}  # of a machine without IPv6


class StartError(Exception):
    """The service cannot be started; the message has the reason and what to do."""


class _Taken(Exception):  # noqa: N818 (never leaves this module)
    """An address cannot be listened on."""

    def __init__(self, host: str, reason: str) -> None:
        super().__init__()
        self.host, self.reason = host, reason


def listen(settings: Settings) -> list[list[socket.socket]]:
    """Return the sockets of each process of the API: one for each address, all of one port.

    Browsers ask 127.0.0.1 and ::1 for what ``localhost`` names, and treat both as one place. If
    another user of the machine listened on one of them, that user's page could send requests to
    the other as if it were the service's own. So the service takes both, if the machine has both.

    Among processes the kernel deals connections out. Of one socket for all, the process that wakes
    first takes nearly every connection.

    Raises
    ------
    StartError
        Somebody listens there, or an address is not this machine's.
    """
    try:
        alone = _free_on_all(settings)  # refused where anybody listens
        if settings.api_processes == 1:
            return [alone]
        port = alone[0].getsockname()[1]
        for listener in alone:
            listener.close()
        shares = range(settings.api_processes)
        return [_on_all(settings.addresses, port, shared=True) for _ in shares]
    except _Taken as taken:
        other = taken.host != settings.addresses[0]
        why = " `localhost` is that address, too, and who has it could pass for this service."
        raise StartError(
            f"Cannot listen on {taken.host}:{settings.port}: {taken.reason}.{why if other else ''} "
            "Choose another port with --port (0 takes a free one)."
        ) from taken


def _free_on_all(settings: Settings) -> list[socket.socket]:
    """Listen on all addresses; without a given port, on one that is free on all of them."""
    for _ in range(TRIES - 1):
        try:
            return _on_all(settings.addresses, settings.port)
        except _Taken:
            if settings.port != 0:
                raise
    return _on_all(settings.addresses, settings.port)


def _on_all(hosts: Sequence[str], port: int, *, shared: bool = False) -> list[socket.socket]:
    """Listen on one port of all addresses that the machine has; raise ``_Taken`` for any other."""
    listeners: list[socket.socket] = []
    for host in hosts:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.create_server(
                (host, port), family=family, backlog=LONGEST_BACKLOG, reuse_port=shared
            )
        except OSError as error:
            if listeners and error.errno in NOT_HERE:
                continue
            for each in listeners:
                each.close()
            raise _Taken(host, os.strerror(error.errno or 0)) from error
        listeners.append(listener)
        port = listener.getsockname()[1]
    return listeners
