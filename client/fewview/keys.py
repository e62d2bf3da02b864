"""The key that lets a client in: where it is found, and who is shown it.

It travels in the header ``Authorization`` alone. No log, error or ``repr`` has it.
"""

import os
import re
import stat
from collections.abc import Callable, Generator
from functools import partial
from ipaddress import ip_address
from pathlib import Path

import httpx2

from fewview.sockets import LISTENING, Address, find, plain

_PRINTED = re.compile(r"[!-~]*")
VARIABLE = "FEWVIEW_KEY"
FOLDER_VARIABLE, USUAL_FOLDER = "FEWVIEW_DATA_DIR", "fewview-data"  # as the server has them
TOKEN_FILE = "token"  # noqa: S105 (its name)
MOST_BYTES = 4096
OPEN_TO_OTHERS = 0o077


class Key(httpx2.Auth):
    """Puts a key into every request; ``find`` is called each time, and may return none."""

    def __init__(self, find: Callable[[], str | None]) -> None:
        self._find = find

    def headers(self) -> dict[str, str]:
        """Return the header that has the key, if there is one."""
        key = self._find()
        return {} if key is None else {"Authorization": f"Bearer {key}"}

    def auth_flow(
        self, request: httpx2.Request
    ) -> Generator[httpx2.Request, httpx2.Response, None]:
        """Put it into one request."""
        request.headers.update(self.headers())
        yield request


def key_for(url: httpx2.URL, key: str | None) -> Key:
    """Return the key of a client.

    It is the one that is given; else that in ``FEWVIEW_KEY``; else, for a service of this machine,
    the token in the data folder, which is read as requests are sent: the service may start later.

    Raises
    ------
    ValueError
        It has characters that no header can hold.
    """
    given, name = (os.environ.get(VARIABLE, ""), VARIABLE) if key is None else (key, "key")
    found = _checked(given, name)
    if found is not None or key is not None:
        return Key(lambda: found)
    if not is_loopback(url.host):
        return Key(lambda: None)
    folder = Path(os.environ.get(FOLDER_VARIABLE) or USUAL_FOLDER).absolute()
    port = url.port or (443 if url.scheme == "https" else 80)
    return Key(partial(_token_for, folder, url.host, port))


def _checked(key: str, name: str = "key") -> str | None:
    """Return a key without blanks around it, None if nothing is left."""
    key = key.strip()
    if not _PRINTED.fullmatch(key):
        raise ValueError(
            f"{name}: a key has letters, digits and signs of ASCII alone, and no blanks; copy it "
            "again as `fewview key create` printed it"
        )
    return key or None


def is_loopback(host: str) -> bool:
    """Return whether a host of a URL is loopback."""
    return bool(_addresses(host))


def _addresses(host: str) -> list[Address]:
    """Return the addresses of loopback that a host is; none if it is another."""
    if host == "localhost":
        return [ip_address("127.0.0.1"), ip_address("::1")]
    try:
        address = plain(ip_address(host))
    except ValueError:
        return []
    return [address] if address.is_loopback else []


def token_in(folder: Path) -> str | None:
    """Return the token of a data folder; None if there is none, or it is not closed to others."""
    found = _read(folder / TOKEN_FILE)
    return None if found is None else found[0]


def _token_for(folder: Path, host: str, port: int) -> str | None:
    """Return the token of a data folder if it may be sent to a port of this machine.

    Before the service has started, any user may listen there and would get the token. So it is sent
    only to root, the user of this process and the owner of the file, if the system reports users.
    """
    found = _read(folder / TOKEN_FILE)
    if found is None:
        return None
    token, owner = found
    try:
        listening = [find((address, port)) for address in _addresses(host)]
    except OSError:  # the system does not report it
        return token
    users = {at.uid for at in listening if at and at.state == LISTENING and at.inode != 0}
    return token if users and users <= {0, os.geteuid(), owner} else None


def _read(path: Path) -> tuple[str, int] | None:
    """Return what is in a file that is closed to others, and whose it is."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags)
    except OSError:
        return None
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode) or found.st_mode & OPEN_TO_OTHERS:
            return None
        key = _checked(os.read(descriptor, MOST_BYTES).decode("ascii", errors="replace"))
    except (OSError, ValueError):
        return None
    finally:
        os.close(descriptor)
    return None if key is None else (key, found.st_uid)
