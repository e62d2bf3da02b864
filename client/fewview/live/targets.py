"""Where poses are sent: VMC, points in OSC, or JSON, all over UDP."""

import json
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np

from fewview.live.bodies import Body
from fewview.live.holding import Pose
from fewview.live.osc import bundles, message

VMC_PORT = 39539
POINT = "/fewview/point"
ROOT = message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Writer(Protocol):
    """Writes a pose as datagrams."""

    def __call__(self, pose: Pose) -> Iterator[bytes]:
        """Give the datagrams of a pose."""


def address_in(text: str, schemes: Sequence[str], option: str) -> tuple[str, str, int]:
    """Return scheme, host and port of a URL.

    Raises
    ------
    ValueError
        It is none of these; the text names the option.
    """
    try:
        parts = urlsplit(text)
        host, port = parts.hostname, parts.port
    except ValueError:
        parts, host, port = urlsplit(""), None, None
    if port is None and parts.scheme == "vmc":
        port = VMC_PORT
    more = parts.path.removeprefix("/") or parts.query or parts.fragment or parts.username
    if parts.scheme not in schemes or not host or port is None or more:
        known = " or ".join(f"{scheme}://host:port" for scheme in schemes)
        raise ValueError(f"{option}: expected {known}, got {text!r}")
    return parts.scheme, host, port


def writer_for(scheme: str, names: Sequence[str], metres: float) -> Writer:
    """Return what writes poses of keypoints with these P names.

    Raises
    ------
    FormatError
        The names are not those of a body, which VMC needs.
    """
    if scheme == "vmc":
        body = Body(names)
        return lambda pose: bundles(_as_vmc(body, pose, metres))
    if scheme == "osc":
        return lambda pose: bundles(_as_points(names, pose))
    return lambda pose: iter([_as_json(names, pose)])


@contextmanager
def about(option: str, host: str, port: int) -> Iterator[None]:
    """Name the option and its address where the system refuses it (OSError)."""
    try:
        yield
    except (OSError, UnicodeError) as error:  # of names that no host can have
        raise OSError(f"{option}: {host} port {port} cannot be used ({error})") from error


def usual_address(host: str, port: int) -> tuple[socket.AddressFamily, tuple[Any, ...]]:
    """Return the family and address of a host for UDP: of IPv4 if it has one.

    Nobody notices a datagram that nobody hears, and of `localhost` most programs listen to that.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, _, _, _, address = min(found, key=lambda each: each[0] != socket.AF_INET)
    return family, address


class Target:
    """A UDP socket to one address; a datagram that cannot be sent is lost, as others on the way."""

    def __init__(self, host: str, port: int) -> None:
        with about("--to", host, port):
            if port == 0:
                raise OSError("no program listens on port 0")
            family, self._address = usual_address(host, port)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, datagram: bytes) -> None:
        """Send a datagram without waiting.

        Raises
        ------
        OSError
            The system does not take it, such as for its size.
        """
        self._socket.sendto(datagram, self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _as_vmc(body: Body, pose: Pose, metres: float) -> Iterator[bytes]:
    bones = body.turned(pose, metres)
    yield message("/VMC/Ext/OK", int(bool(bones)))
    yield message("/VMC/Ext/T", time.monotonic())
    yield ROOT
    for bone in bones:
        yield message("/VMC/Ext/Bone/Pos", bone.name, *bone.position, *bone.rotation)


def _as_points(names: Sequence[str], pose: Pose) -> Iterator[bytes]:
    """Give a message for each point that is not gone; while it fades, its sd grows."""
    for place, weight in enumerate(pose.weights.tolist()):
        if weight > 0:
            point, sd = pose.points[place].tolist(), float(pose.sds[place])
            yield message(POINT, names[place], *point, sd / weight)


def _as_json(names: Sequence[str], pose: Pose) -> bytes:
    points: list[dict[str, Any]] = []
    for place, weight in enumerate(pose.weights.tolist()):
        if weight > 0:
            sd = float(pose.sds[place])
            points.append(
                {
                    "name": names[place],
                    "position": pose.points[place].tolist(),
                    "sd": sd if np.isfinite(sd) else None,
                    "weight": weight,
                }
            )
    return json.dumps({"sequence": pose.sequence, "points": points}).encode()
