"""Processes and ports of one test session, which those of another have nothing to do with."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from worker import process


def tied(*words: str) -> list[str]:
    """Return a command of Python's that ends with this process, even if that is killed.

    A worker that was left behind would take the jobs of later sessions.
    """
    return process.tied(*process.python(*words))


def free_port() -> int:
    """Return a port that the system picks; two sessions at a time get different ones."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def processes() -> dict[int, int]:
    """Return the parent of every process that lives; zombies do not."""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if state != "Z":
            found[int(stat.parent.name)] = int(parent)
    return found


def descendants(pid: int) -> set[int]:
    parents = processes()
    found = {pid}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    return found - {pid}


def command_of(pid: int) -> bytes:
    """Return the command line of a process; nothing if it has just ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@contextmanager
def growth(parent: int, program: bytes) -> Iterator[list[int]]:
    """Give by how many bytes descendants that run a program have grown at most, once it is over."""
    pids = [pid for pid in descendants(parent) if program in command_of(pid)]
    assert pids

    def of(name: str) -> int:
        files = [Path(f"/proc/{pid}/status").read_text() for pid in pids]
        rows = [row.split() for file in files for row in file.splitlines()]
        return sum(1024 * int(row[1]) for row in rows if row[0] == f"{name}:")

    for pid in pids:
        Path(f"/proc/{pid}/clear_refs").write_text("5")
    before, grew = of("VmRSS"), [0]
    yield grew
    grew[0] = of("VmHWM") - before
