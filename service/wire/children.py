"""What processes that read the files and bodies of strangers have in common."""

import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

MOST_OPEN = 256  # files
FIRST_TO_END = "1000"  # of what the kernel ends where memory is full
# All that they get of the environment, which holds passwords: of records, of objects, ...
KEPT = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "LD_LIBRARY_PATH")
# OpenBLAS sets addresses aside for each thread; HDF5 loads programs for filters, but for "::".
OWN = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}


def child_code(*statements: str) -> str:
    """Return Python code that does the statements with the modules of this process.

    The paths are those of this process: a child with ``-P`` would not find what tests import. Whole
    ones, for in the child's working directory may lie the files of strangers.
    """
    places = [str(Path(place).resolve()) for place in sys.path]
    return "; ".join((f"import sys; sys.path[:] = {places!r}", *statements))


def child_environment(**more: str) -> dict[str, str]:
    """Return the environment of a child: without passwords."""
    return {name: os.environ[name] for name in KEPT if name in os.environ} | OWN | more


def limit(memory: int, seconds: int, file_bytes: int = 0) -> None:
    """Bound this process, for good, and have it end first where memory is full.

    Parameters
    ----------
    memory
        Bytes of addresses.
    seconds
        Of processor time; SIGXCPU ends it then.
    file_bytes
        Of each file that it writes; writing more is an error.
    """
    with suppress(OSError):  # no Linux
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_END)
    for kind, most in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, file_bytes),
        (resource.RLIMIT_NOFILE, MOST_OPEN),
        (resource.RLIMIT_NPROC, 0),  # more: it stays one, with one thread
    ):
        resource.setrlimit(kind, (most, most))
