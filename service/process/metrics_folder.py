"""The folder in which the API's processes count, for as long as their supervisor lives."""

import atexit
import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

PREFIX = "fewview-metrics-"


def make_folder() -> Path:
    """Make a folder among the temporary ones, which goes when this process ends.

    Those of supervisors that were killed go now. Each holds a lock on its own (which also keeps
    those who clean up temporary files away), and who is killed holds none.
    """
    with suppress(OSError):  # none is in anybody's way
        for other in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
            _remove_if_left(other)
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)  # held until this process ends
    fcntl.flock(lock, fcntl.LOCK_EX)
    (folder / "held").touch()  # before that it may be about to be locked
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError):
        found = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            ours = os.fstat(found).st_uid == os.geteuid() and (folder / "held").exists()
            if ours:
                fcntl.flock(found, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(found)
