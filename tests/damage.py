"""What happens to files that nobody touches."""

from collections.abc import Callable
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


HARMS: tuple[Callable[[Path], None], ...] = (flip, truncate, empty, Path.unlink)
