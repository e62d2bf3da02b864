"""The user of a TCP socket of this machine, from Linux over netlink (sock_diag(7)).

This is the user who made the socket, even if another holds it now.
"""

import errno
import os
import socket
import struct
import sys
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import NamedTuple

Address = IPv4Address | IPv6Address
End = tuple[Address, int]  # an address and a port

SOCK_DIAG, SOCK_DIAG_BY_FAMILY, REQUEST, ERROR = 4, 20, 1, 2  # linux/netlink.h, sock_diag.h
HEADER = struct.Struct("=IHHII")  # nlmsghdr: length, type, flags, sequence, port
ERROR_NUMBER = struct.Struct("=i")  # nlmsgerr
ENDS = struct.Struct("!HH16s16s")  # inet_diag_sockid: ports and addresses, source first
QUESTION = struct.Struct("=BBBxI")  # inet_diag_req_v2: family, protocol, extensions, states
ANY_SOCKET = struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)  # interface and cookie
ANSWER = struct.Struct("=BBxx36s12x12xII")  # inet_diag_msg: family, state, ends, user, inode
ANSWER_BYTES = 4096

# States (tcp_states.h) of a connection that both ends had: ESTABLISHED, FIN_WAIT1, FIN_WAIT2 (this
# end has shut its writing down) and CLOSE_WAIT (the other end has).
CONNECTED = {1, 4, 5, 8}
LISTENING = 10


class Socket(NamedTuple):
    """A socket: its own end and the other, its state, the user who made it, and its inode.

    A socket that no process has any more has the inode 0, and is root's in every answer. The kernel
    reads the user before the inode (inet_diag.c), so what has an inode is of this user.
    """

    source: End
    target: End
    state: int
    uid: int
    inode: int


def plain(address: Address) -> Address:
    """Return IPv4 that is written as IPv6 (``::ffff:127.0.0.1``) as IPv4, others as they are."""
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return mapped or address


def find(source: End, target: End | None = None) -> Socket | None:
    """Return the connection between two ends, else the listener at the first; None without either.

    It takes some 50 microseconds and never waits. IPv4 must be written as such.

    Raises
    ------
    OSError
        The system does not provide it.
    """
    if sys.platform != "linux":
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    address, port = source
    family, other, other_port = socket.AF_INET, bytes(4), 0
    if address.version == 6:
        family, other = socket.AF_INET6, bytes(16)
    if target is not None:
        other, other_port = target[0].packed, target[1]
    try:
        ends = ENDS.pack(port, other_port, address.packed, other)
    except struct.error:  # a port that none has
        return None
    body = QUESTION.pack(family, socket.IPPROTO_TCP, 0, 0xFFFFFFFF) + ends + ANY_SOCKET
    head = HEADER.pack(HEADER.size + len(body), SOCK_DIAG_BY_FAMILY, REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, SOCK_DIAG) as kernel:
        kernel.setblocking(False)  # the answer is there once the question has been sent
        kernel.sendto(head + body, (0, 0))
        answer, (sender, _) = kernel.recvfrom(ANSWER_BYTES)
    if sender != 0 or len(answer) < HEADER.size + ERROR_NUMBER.size:
        raise OSError(errno.EPROTO, os.strerror(errno.EPROTO))
    return _read(answer)


def _read(answer: bytes) -> Socket | None:
    kind = HEADER.unpack_from(answer)[1]
    if kind == ERROR:
        (number,) = ERROR_NUMBER.unpack_from(answer, HEADER.size)
        if -number == errno.ENOENT:
            return None
        raise OSError(-number, os.strerror(-number))
    if kind != SOCK_DIAG_BY_FAMILY or len(answer) < HEADER.size + ANSWER.size:
        raise OSError(errno.EPROTO, os.strerror(errno.EPROTO))
    family, state, ends, uid, inode = ANSWER.unpack_from(answer, HEADER.size)
    size = 4 if family == socket.AF_INET else 16
    source_port, target_port, *packed = ENDS.unpack(ends)
    source, target = (plain(ip_address(address[:size])) for address in packed)
    return Socket((source, source_port), (target, target_port), state, uid, inode)
