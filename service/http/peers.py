"""Which user is at the other end of a connection over loopback: the kernel knows.

It names who made the other socket: the connection of a proxy is the proxy's.
"""

import os
import socket
from collections.abc import Set as AbstractSet
from functools import cache, cached_property
from ipaddress import ip_address
from pathlib import Path

from fewview.sockets import CONNECTED, End, Socket, find, plain

OVERFLOW = Path("/proc/sys/kernel/overflowuid")
USUAL_OVERFLOW = 65534


def peer_uid(client: tuple[str, int], server: tuple[str, int]) -> int | None:
    """Return the user whose process is at a client's end of a TCP connection over loopback.

    It takes some 50 microseconds and never waits.

    Parameters
    ----------
    client, server
        Address and port of either end: IPv4, IPv6, or IPv4 as IPv6 has it (``::ffff:127.0.0.1``).

    Returns
    -------
    int | None
        None if unknown: the client is not in this network namespace, it has closed its socket, an
        address is not loopback, or the system does not provide it.
    """
    theirs, ours = _end(client), _end(server)
    if theirs is None or ours is None:
        return None
    found = _held(theirs, ours)
    return None if found is None else found.uid


class Peer:
    """The other end of one connection of ours.

    The kernel is asked when it matters first, and its answer holds as long as the connection.
    """

    def __init__(self, connection: socket.socket | None) -> None:
        self._client: object = None
        self._server: object = None
        self._inode: int | None = None
        try:
            if connection is not None:
                self._client, self._server = connection.getpeername(), connection.getsockname()
                self._inode = os.fstat(connection.fileno()).st_ino
        except OSError:
            pass  # it is lost already

    @cached_property
    def trusted(self) -> bool:
        """Whether it is a process of root or of the user that this process has.

        A client may send a request, close its connection and leave its port to a process of another
        user, which connects from there. So our end is checked after the client's: while it is
        connected, no other process can be at the other end.
        """
        theirs, ours = _end(self._client), _end(self._server)
        if theirs is None or ours is None:
            return False
        peer = _held(theirs, ours)
        if peer is None or peer.uid not in _trusted_uids():
            return False
        own = _held(ours, theirs)
        return own is not None and own.inode == self._inode


@cache
def _trusted_uids() -> AbstractSet[int]:
    """Return root and our own user, without the one that the kernel reports for unknown users.

    That user (overflowuid) stands for all users outside of the user namespace.
    """
    try:
        overflow = int(OVERFLOW.read_text())
    except (OSError, ValueError):
        overflow = USUAL_OVERFLOW
    return {0, os.geteuid()} - {overflow}


def _end(end: object) -> End | None:
    """Return an end as it is compared: IPv4 as such; None if it is not of loopback."""
    try:
        host, port = end[:2]  # type: ignore[index]
        address = plain(ip_address(host))
    except (TypeError, ValueError):  # not known, or of a Unix socket
        return None
    return (address, port) if address.is_loopback else None


def _held(source: End, target: End) -> Socket | None:
    """Return the socket of exactly this connection, if a process has it open."""
    if source[0].version != target[0].version:
        return None
    try:
        found = find(source, target)
    except OSError:
        return None
    if found is None or (found.source, found.target) != (source, target):
        return None
    return found if found.state in CONNECTED and found.inode != 0 else None
