"""What happens to files that nobody touches."""

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path


def flip(file: Path) -> None:
    """Change one bit, as a disk does in years."""
    data = bytearray(file.read_bytes())
    data[-3] ^= 4
    file.write_bytes(data)


def truncate(file: Path) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])


def empty(file: Path) -> None:
    file.write_bytes(b"")


def spoil_records(file: Path, table: str) -> None:
    """Overwrite a page of an SQLite database, which may be in use: the first of a table."""
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        (size,) = connection.execute("PRAGMA page_size").fetchone()
        asked = "SELECT rootpage FROM sqlite_master WHERE name = ?"
        (page,) = connection.execute(asked, [table]).fetchone()
    with file.open("r+b") as pages:
        pages.seek((page - 1) * size)
        pages.write(b"\xa5" * size)


HARMS: tuple[Callable[[Path], None], ...] = (flip, truncate, empty, Path.unlink)
