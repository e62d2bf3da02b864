"""Processes that are started again whenever they end, as a supervisor of containers does it."""

import os
import re
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from worker.process import tied

POLL_SECONDS = 0.1
STOP_SECONDS = 40.0
ENDED = re.compile(r"((?:API|Worker) \d+|Valkey) ended \((-?\d+)\)")
# How a process ends that somebody ended, or (2) whose queue was away as it started.
MEANT = (0, 2, -signal.SIGTERM, -signal.SIGKILL)


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


class Part:
    """A process of a deployment. What it prints goes to a file beside those of the others."""

    def __init__(
        self,
        name: str,
        command: list[str],
        environment: dict[str, str],
        folder: Path,
        report: Callable[[str], None],
    ) -> None:
        """Prepare a process; `report` hears of ends that nobody meant."""
        self.name, self.command, self.environment = name, command, environment
        self.log = folder / f"{name.replace(' ', '_')}.log"
        self.restarts = 0
        self._report = report
        self._lock = threading.Lock()
        self._wanted = False
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Its process; 0 while there is none."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else 0

    def start(self) -> None:
        """Let the supervisor start the process."""
        self._wanted = True

    def watch(self) -> None:
        """Start the process, also again if it has ended.

        By one thread that lives on: the kernel ends a process with the thread that made it.
        """
        with self._lock:
            process = self._process
            if not self._wanted or (process is not None and process.poll() is None):
                return
            if process is not None:
                self.restarts += 1
                if process.returncode not in MEANT:
                    self._report(f"{self.name} ended by itself with status {process.returncode}")
            self._start()

    def stop(self) -> None:
        """Have the process end, and not be started again."""
        with self._lock:
            self._wanted, process = False, self._process
            self._process = None
        if process is None:
            return
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._report(f"{self.name} did not end within {STOP_SECONDS:.0f} s of SIGTERM")
            process.kill()
            process.wait()

    def _start(self) -> None:
        # Through a pipe: a limit on the sizes of files is not to end what it prints.
        self._process = subprocess.Popen(  # noqa: S603
            tied(*self.command),
            env=os.environ | self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        threading.Thread(target=self._keep, args=(self._process,), daemon=True).start()

    def _keep(self, process: "subprocess.Popen[bytes]") -> None:
        assert process.stdout is not None
        with self.log.open("ab", buffering=0) as file, process.stdout:
            for line in process.stdout:
                file.write(time.strftime("%H:%M:%S ").encode() + line)
                if (found := ENDED.search(line.decode(errors="replace"))) is not None:
                    self.restarts += 1
                    if int(found[2]) not in MEANT:
                        ended = f"ended by itself with status {found[2]}"
                        self._report(f"{self.name}: {found[1]} {ended}")


def parents() -> dict[int, int]:
    """Return the parent of every process that lives; zombies do not."""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
            if state != "Z":
                found[int(stat.parent.name)] = int(parent)
    return found


def family(*pids: int) -> set[int]:
    """Return processes and all their descendants."""
    of = parents()
    found = {pid for pid in pids if pid in of}
    while more := {child for child, parent in of.items() if parent in found} - found:
        found |= more
    return found


def marked(mark: str) -> set[int]:
    """Return the processes that live and began with these words in their environment."""
    found = set()
    for file in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if mark.encode() in file.read_bytes():
                found.add(int(file.parent.name))
    return found


def words(pid: int) -> str:
    """Return the command line of a process, empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


def those(pids: set[int], *wanted: str) -> Iterator[int]:
    """Yield the processes whose command lines hold all these words, children of such left out."""
    of = parents()
    named = {pid for pid in pids if all(word in words(pid) for word in wanted)}
    yield from sorted(pid for pid in named if of.get(pid) not in named)


def send(number: signal.Signals, *pids: int) -> None:
    """Send a signal to processes, as far as they are still there."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)
