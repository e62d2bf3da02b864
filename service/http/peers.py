"""Which user is at the other end of a connection over loopback: the kernel knows.

Linux answers this over netlink (sock_diag(7)) for one connection by its two ends. The answer has
the user who made the socket, whoever holds it now: the connection of a proxy is the proxy's.
"""

import os
import socket
import struct
import sys
from collections.abc import Set as AbstractSet
from functools import cache, cached_property
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import NamedTuple

Address = IPv4Address | IPv6Address
End = tuple[Address, int]  # its address and its port

SOCK_DIAG, SOCK_DIAG_BY_FAMILY, REQUEST = 4, 20, 1  # linux/netlink.h, linux/sock_diag.h
HEADER = struct.Struct("=IHHII")  # nlmsghdr: length, type, flags, sequence, port
ENDS = struct.Struct("!HH16s16s")  # inet_diag_sockid: ports and addresses, source first
QUESTION = struct.Struct("=BBBxI")  # inet_diag_req_v2: family, protocol, extensions, states
ANY_SOCKET = struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)  # interface and cookie
ANSWER = struct.Struct("=BBxx36s12x12xII")  # inet_diag_msg: family, state, ends, user, inode
ANSWER_BYTES = 4096
# The states of a connection whose ends both had it (tcp_states.h): ESTABLISHED, FIN_WAIT1,
# FIN_WAIT2 (this end has shut its writing down) and CLOSE_WAIT (the other end has).
CONNECTED = {1, 4, 5, 8}
OVERFLOW = Path("/proc/sys/kernel/overflowuid")
USUAL_OVERFLOW = 65534


class _Socket(NamedTuple):
    uid: int
    inode: int


def peer_uid(client: tuple[str, int], server: tuple[str, int]) -> int | None:
    """Return the user whose process is at a client's end of a TCP connection over loopback.

    It takes some 50 microseconds and waits for nobody.

    Parameters
    ----------
    client, server
        Address and port of either end: IPv4, IPv6, or IPv4 as IPv6 has it (``::ffff:127.0.0.1``).

    Returns
    -------
    int | None
        None where it cannot be known: the client is no process of this network namespace, it has
        closed its socket, an address is not of loopback, or the system has no such question.
    """
    theirs, ours = _end(client), _end(server)
    if theirs is None or ours is None:
        return None
    found = _ask(theirs, ours)
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

        A client may send a request, break its connection off and leave its port to a process of
        another user, which connects from there. So our end is looked at after theirs: while that
        is connected, nobody else can be at the other end.
        """
        theirs, ours = _end(self._client), _end(self._server)
        if theirs is None or ours is None:
            return False
        peer = _ask(theirs, ours)
        if peer is None or peer.uid not in _trusted_uids():
            return False
        own = _ask(ours, theirs)
        return own is not None and own.inode == self._inode


@cache
def _trusted_uids() -> AbstractSet[int]:
    """Return root and our own user, unless that is the one whom the kernel names for unknown ones.

    That user (overflowuid) stands for everybody whom a user namespace does not know.
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
        address = _plain(ip_address(host))
    except (TypeError, ValueError):  # not known, or of a Unix socket
        return None
    return (address, port) if address.is_loopback else None


def _plain(address: Address) -> Address:
    return getattr(address, "ipv4_mapped", None) or address


def _ask(source: End, target: End) -> _Socket | None:
    """Return the socket that has these ends, if a process has it open."""
    if sys.platform != "linux":
        return None
    family = socket.AF_INET if source[0].version == 4 else socket.AF_INET6
    try:
        ends = ENDS.pack(source[1], target[1], source[0].packed, target[0].packed)
        body = QUESTION.pack(family, socket.IPPROTO_TCP, 0, 0xFFFFFFFF) + ends + ANY_SOCKET
        head = HEADER.pack(HEADER.size + len(body), SOCK_DIAG_BY_FAMILY, REQUEST, 1, 0)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, SOCK_DIAG) as kernel:
            kernel.setblocking(False)  # the answer is there when the question has been sent
            kernel.sendto(head + body, (0, 0))
            answer, (sender, _) = kernel.recvfrom(ANSWER_BYTES)
        if sender != 0 or HEADER.unpack_from(answer)[1] != SOCK_DIAG_BY_FAMILY:
            return None
        return _read(answer, source, target)
    except (OSError, struct.error, ValueError):
        return None


def _read(answer: bytes, source: End, target: End) -> _Socket | None:
    """Read who has the socket; a socket that nobody has any more is root's in every answer.

    The kernel reads the user first and the inode then (inet_diag.c). When an owner closes a socket
    it loses its inode, so one with an inode was still its owner's as the user was read.
    """
    family, state, ends, uid, inode = ANSWER.unpack_from(answer, HEADER.size)
    size = 4 if family == socket.AF_INET else 16
    ports_and_addresses = ENDS.unpack(ends)
    addresses = [_plain(ip_address(packed[:size])) for packed in ports_and_addresses[2:]]
    found = tuple(zip(addresses, ports_and_addresses[:2], strict=True))
    if found != (source, target) or state not in CONNECTED or inode == 0:
        return None
    return _Socket(uid, inode)
