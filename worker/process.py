"""Starting processes of ours: they die with their parent, and import what is installed alone."""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # prctl(2)


def python(*words: str) -> list[str]:
    """Return a command of Python's that imports nothing from the working directory.

    Without ``-P``, ``python -m`` looks there first, and people have folders called ``models``.
    """
    return [sys.executable, "-P", *words]


def tied(*command: str) -> list[str]:
    """Return a command that runs ``command`` and has it die with the process that calls this."""
    return python("-m", "worker.process", str(os.getpid()), *command)


def die_with_parent(parent: int) -> None:
    """Have the kernel kill this process when ``parent`` dies, however it dies (Linux).

    Elsewhere nothing happens, and a process whose parent is killed lives on; the fencing of fits
    keeps its writes from counting.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the call
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":  # python -m worker.process PARENT PROGRAM [ARGUMENT ...]
    die_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])  # noqa: S606 (the signal outlives the exec)
