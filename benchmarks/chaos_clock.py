"""Python processes whose clocks are off, as those of another host would be."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CLOCK = "FEWVIEW_CHAOS_CLOCK"  # names the file with the seconds that new workers' clocks are off
# Imported by every Python as it starts. The clock of the records, which is the database's, and
# those that count from a start are left alone.
SHIFT_CLOCK = f'''
import datetime, os, sys, time
if "worker" in sys.orig_argv and os.path.exists(os.environ.get("{CLOCK}", "")):
    off = float(open(os.environ["{CLOCK}"]).read())
    true_time, true_ns, true = time.time, time.time_ns, datetime.datetime
    time.time = lambda: true_time() + off
    time.time_ns = lambda: true_ns() + int(off * 1e9)

    class Kind(type):
        def __instancecheck__(cls, value):
            return isinstance(value, true)

    class datetime_off(true, metaclass=Kind):
        @classmethod
        def now(cls, tz=None):
            return true.now(tz) + datetime.timedelta(seconds=off)

        @classmethod
        def utcnow(cls):
            return true.utcnow() + datetime.timedelta(seconds=off)

    datetime.datetime = datetime_off
'''


class Clocks:
    """The clocks of workers that get the environment of this."""

    def __init__(self, folder: Path) -> None:
        """Keep in a folder, which is made, what Python imports as it starts."""
        folder.mkdir(parents=True)
        (folder / "sitecustomize.py").write_text(SHIFT_CLOCK)
        self._file = folder / "seconds"
        path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
        self.environment = {"PYTHONPATH": path, CLOCK: str(self._file)}

    @contextmanager
    def off(self, seconds: float) -> Iterator[None]:
        """Have the workers that start meanwhile go by a wrong clock as long as they live."""
        self._file.write_text(str(seconds))
        try:
            yield
        finally:
            self._file.unlink()
