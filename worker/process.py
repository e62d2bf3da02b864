"""Starting processes of ours: they die with their parent, and import what is installed alone."""

import ctypes
import os
import signal
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # prctl(2)


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
    if _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) and os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)  # the parent died before the call


def tie_forks() -> None:
    """Have every process that this one forks from now on die with it, whatever forks it.

    The kernel ties a process to the thread that forked it: a thread that forks must live as long.
    What a forked process forks is tied to that one in the same way.
    """
    os.register_at_fork(before=_note_parent, after_in_child=lambda: die_with_parent(_parent))


def _note_parent() -> None:
    global _parent  # noqa: PLW0603 (the child has a copy)
    _parent = os.getpid()


_parent = 0


def adopt_orphans() -> None:
    """Have descendants of this process whose parent dies become its children (Linux)."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def children() -> set[int]:
    """Return the children of this process, those that have ended too; none where no Linux is."""
    found: set[int] = set()
    for file in Path("/proc/self/task").glob("*/children"):
        with suppress(OSError):  # a thread that has just ended
            found.update(map(int, file.read_text().split()))
    return found


def end_children(spared: Collection[int]) -> set[int]:
    """Kill the children of this process except some, and their orphans; return their ids.

    Orphans come to this process only after ``adopt_orphans``.
    """
    ended: set[int] = set()
    while left := children().difference(spared):
        for pid in left:
            with suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        ended |= left
    return ended


def _prctl(option: int, value: int) -> bool:
    """Call prctl(2); return whether there is one."""
    if not sys.platform.startswith("linux"):
        return False
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
    return True


if __name__ == "__main__":  # python -m worker.process PARENT PROGRAM [ARGUMENT ...]
    die_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])  # noqa: S606 (the signal outlives the exec)
