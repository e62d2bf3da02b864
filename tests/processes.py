"""Processes and ports of one test session, which those of another have nothing to do with."""

import socket

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
