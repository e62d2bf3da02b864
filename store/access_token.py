"""The token in the data folder: who can read that file may do everything.

It is for processes of the service's own user whose connections do not show whose they are.
"""

import os
import re
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from store.access_keys import TOKEN_PREFIX, new_token
from store.errors import StoreError

NAME = "token"
TOKEN = re.compile(f"{TOKEN_PREFIX}[A-Za-z0-9_-]{{43}}")  # base64url has 6 bits a character
MOST_BYTES = 4096
OPEN_TO_OTHERS = 0o077


def ensure(data_dir: Path) -> str:
    """Return the token of a data folder, making it if it does not exist.

    Processes that make it at the same time agree on one. No process ever reads a part of it.

    Raises
    ------
    StoreError
        The file is another user's, others can read or write it, or it holds no token; the message
        has the remedy.
    """
    path = (data_dir / NAME).absolute()
    try:
        with suppress(FileNotFoundError):
            return _read(path)
        _make(path)
        return _read(path)
    except OSError as error:
        raise StoreError(f"{path} cannot be used: {error.strerror}.") from error


def _make(path: Path) -> None:
    """Write a new token to a file beside, then give it its name, unless there is one by now."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, part = tempfile.mkstemp(prefix=f".{NAME}-", dir=path.parent)  # of mode 600
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(f"{new_token()}\n")
            file.flush()
            os.fsync(descriptor)
        with suppress(FileExistsError):
            os.link(part, path)
    finally:
        Path(part).unlink()


def _read(path: Path) -> str:
    if path.is_symlink():
        raise StoreError(f"{path} is a link: delete it, and a new token will be made.")
    # Without waiting, if the file is a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        _check_closed(path, os.fstat(descriptor))
        text = os.read(descriptor, MOST_BYTES).decode("ascii", errors="replace").strip()
    finally:
        os.close(descriptor)
    if not TOKEN.fullmatch(text):
        raise StoreError(f"{path} holds no token: delete it, and a new one will be made.")
    return text


def _check_closed(path: Path, found: os.stat_result) -> None:
    """Raise ``StoreError`` unless it is a file of ours that is closed to others."""
    if not stat.S_ISREG(found.st_mode):
        raise StoreError(f"{path} is no file: delete it, and a new token will be made.")
    if found.st_uid != os.geteuid():
        raise StoreError(
            f"{path} belongs to another user, who knows the token: delete it, and a new one will "
            "be made."
        )
    if found.st_mode & OPEN_TO_OTHERS:
        raise StoreError(
            f"Other users can read {path}, or write it. If no one has done so, close it with "
            f"`chmod 600 {path}`; else delete it, and a new token will be made."
        )
