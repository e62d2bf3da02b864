"""Processes for the files and bodies of strangers: bounded in memory, time and files, and confined.

A few bytes may take gigabytes to read, functions in C block all other threads of their process, and
a library that a file crashes or takes over shall have nothing in reach (`confinement.py`). To start
a process takes long, however. So one is kept that imports what is needed once, and forks another
for each piece of work, which ends with its answer; none outlives the process that uses it. What
comes back is not trusted: it is JSON and arrays, of bounded size.

How many work at a time is bounded by who asks for them (`app.py`). Should they fill the machine's
memory all the same, the kernel ends one of them first.
"""

import atexit
import gc
import json
import logging
import math
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.wire.arrays import Arrays
from service.wire.confinement import confine
from worker.process import die_with_parent, python

logger = logging.getLogger(__name__)

SECONDS = 120  # by the clock, and of processor time
OWN_BYTES = 2**30  # addresses that Python and its libraries take
MOST_OPEN = 256  # files
FIRST_TO_END = "1000"  # of what the kernel ends where memory is full
NICENESS = 5  # so that others go on with what is quick
HEADER_BYTES = 8  # the length of the JSON that begins each message, little-endian
DTYPES = ("<f4", "<f8")
LONGEST_ANSWER = 16 * 2**20  # bytes of JSON: what is valid beside arrays is little
LONGEST_NAMES, LONGEST_LOG = 1000, 2000
# All that they get of the environment, which holds passwords: of records, of objects, ...
KEPT = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "LD_LIBRARY_PATH")
# OpenBLAS sets addresses aside for each thread; HDF5 loads programs for filters, but for "::".
OWN = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}


class EndedError(Exception):
    """A process ended without an answer."""


class LateError(EndedError):
    """A process took too long, and was killed."""


FAULTS = (EndedError, OSError, LookupError, TypeError, ValueError, RecursionError)


class Limits(NamedTuple):
    """What one piece of work may take.

    Attributes
    ----------
    memory
        Bytes of addresses, beside those that Python and its libraries take.
    arrays
        Bytes of the arrays that it answers.
    file
        Bytes of each file that it writes.
    """

    memory: int
    arrays: int
    file: int = 0
    seconds: float = SECONDS


class Sandbox:
    """Forks confined processes that do one piece of work each. Safe to use from many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._server: _Server | None = None

    def work(
        self,
        modules: Sequence[str],
        asked: dict[str, Any],
        data: bytes = b"",
        *,
        limits: Limits,
        folder: Path | None = None,
    ) -> tuple[dict[str, Any], Arrays]:
        """Have a new process do the work.

        Parameters
        ----------
        modules
            Imported once for all. The first has the function ``work``, which gets ``asked`` and
            ``data``, and returns JSON and arrays.
        folder
            Its working directory, all that it can read and write; None: no file at all.

        Raises
        ------
        LateError
            If it takes longer than the limit.
        EndedError
            If it ends without an answer, or answers with more than it may have, or with what no
            answer is: what it has read may have taken it over.
        """
        header = {
            "asked": asked,
            "size": len(data),
            "folder": folder and str(folder.resolve()),
            "limits": limits,
        }
        server = self._running()
        try:
            return server.work(modules, header, data, limits)
        except LateError:
            raise
        except EndedError:
            if not server.has_ended():
                raise
        # It was killed, and not by this work.
        return self._running().work(modules, header, data, limits)

    def stop(self) -> None:
        """Kill what forks; it is started again when it is needed."""
        with self._lock:
            if self._server is not None:
                self._server.stop()
                self._server = None

    def _running(self) -> "_Server":
        with self._lock:
            if self._server is not None and self._server.has_ended():
                self._server.stop()
                self._server = None
            if self._server is None:
                self._server = _Server()
            return self._server


shared = Sandbox()  # of all bodies and files of this process


class _Server:
    """The process that forks; it ends when this process closes its end, however it does."""

    def __init__(self) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The paths are those of this process: a child with ``-P`` would not find what tests import.
        paths = [str(Path(place).resolve()) for place in sys.path]
        code = (
            f"import sys; sys.path[:] = {paths!r}; import socket; from {__name__} import serve; "
            f"serve(socket.socket(fileno={theirs.fileno()}))"
        )
        kept = {name: os.environ[name] for name in KEPT if name in os.environ}
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (our own program)
                python("-c", code),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=kept | OWN,
                start_new_session=True,  # Ctrl-C is for this process
            )
        self._owner = os.getpid()
        atexit.register(self.stop)

    def work(
        self, modules: Sequence[str], header: dict[str, Any], data: bytes, limits: Limits
    ) -> tuple[dict[str, Any], Arrays]:
        """Have a new process do the work; it is killed if that takes too long."""
        ours, theirs = socket.socketpair()
        with ours:
            late = threading.Event()
            worker: list[int] = []  # its file descriptor

            def end() -> None:
                late.set()
                with suppress(OSError):
                    ours.shutdown(socket.SHUT_RDWR)

            timer = threading.Timer(limits.seconds, end)
            timer.start()
            try:
                with theirs:
                    names = json.dumps(list(modules)).encode()
                    socket.send_fds(self._channel, [names], [theirs.fileno()])
                worker += socket.recv_fds(ours, 1, 1)[1]
                _send(ours, header)
                if data:  # else it may have answered and gone by now
                    ours.sendall(data)
                return _receive_answer(ours, limits.arrays)
            except FAULTS as error:
                raise (LateError if late.is_set() else EndedError) from error
            finally:
                timer.cancel()
                timer.join()
                for descriptor in worker:
                    with suppress(OSError):  # it has ended
                        signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                    os.close(descriptor)

    def has_ended(self) -> bool:
        """Whether it was killed, or belongs to a process that this one was forked from."""
        if self._owner != os.getpid():
            return True
        try:
            self._channel.recv(1, socket.MSG_DONTWAIT)
        except BlockingIOError:  # it never writes anything
            return False
        except OSError:  # another thread has closed this end
            pass
        return True

    def stop(self) -> None:
        """Kill it."""
        self._channel.close()
        atexit.unregister(self.stop)
        if self._owner == os.getpid():
            self._process.kill()
            self._process.wait()


def serve(channel: socket.socket) -> None:
    """Fork a process for each request, until the parent has closed its end."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # ended children need no wait
    parent = os.getpid()
    while True:
        names, descriptors, _, _ = socket.recv_fds(channel, LONGEST_NAMES, 1)
        if not names:
            return
        work, *_ = [import_module(name) for name in json.loads(names)]
        gc.disable()  # what a process leaves goes with it, and to search for it takes long
        with socket.socket(fileno=descriptors[0]) as connection, suppress(OSError):
            child = os.fork()
            if child == 0:
                channel.close()
                _serve_one(connection, parent, work)
            _introduce(connection, child)


def _introduce(connection: socket.socket, child: int) -> None:
    """Give who asked a hold of the process that works, by which it can be killed (Linux)."""
    held = []
    with suppress(AttributeError, OSError):
        held.append(os.pidfd_open(child))
    socket.send_fds(connection, [b"."], held)
    for descriptor in held:
        os.close(descriptor)


def _serve_one(connection: socket.socket, parent: int, module: Any) -> None:
    """Do one piece of work, and end this process."""
    try:
        die_with_parent(parent)
        os.nice(NICENESS)
        given = _receive(connection, LONGEST_ANSWER)
        data = bytearray(given["size"])
        _fill(connection, memoryview(data))
        folder, limits = given["folder"], Limits(*given["limits"])
        if folder is not None:
            os.chdir(folder)
            tempfile.tempdir = folder  # what it unpacks goes with the folder, even if it is killed
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for output in (1, 2):
            os.dup2(nowhere, output)
        _limit(limits)
        confine(folder and Path())
        try:
            answer, arrays = module.work(given["asked"], data)
        except BaseException:  # noqa: BLE001 (no caller above reports it)
            _send(connection, {"failed": traceback.format_exc()[-LONGEST_LOG:]})
            return
        shapes = {n: (a.dtype.str, a.shape) for n, a in arrays.items()}
        _send(connection, {"answer": answer, "arrays": shapes})
        for array in arrays.values():
            connection.sendall(np.ascontiguousarray(array).data.cast("B"))
    finally:
        os._exit(0)


def _limit(limits: Limits) -> None:
    """Bound this process, for good, and have it end first where memory is full."""
    with suppress(OSError):  # no Linux
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_END)
    for kind, most in (
        (resource.RLIMIT_AS, OWN_BYTES + limits.memory),
        (resource.RLIMIT_CPU, math.ceil(limits.seconds)),  # SIGXCPU ends it then
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, limits.file),
        (resource.RLIMIT_NOFILE, MOST_OPEN),
        (resource.RLIMIT_NPROC, 0),  # more: it stays one, with one thread
    ):
        resource.setrlimit(kind, (most, most))


def _receive_answer(process: socket.socket, most: int) -> tuple[dict[str, Any], Arrays]:
    """Return an answer, whose arrays have so many bytes at most, together."""
    message = _receive(process, LONGEST_ANSWER)
    if "failed" in message:
        logger.warning("Work in the sandbox failed: %r", str(message["failed"])[-LONGEST_LOG:])
        raise EndedError
    arrays: Arrays = {}
    left = most
    for name, (dtype, shape) in dict(message["arrays"]).items():
        if dtype not in DTYPES or not all(type(size) is int and size >= 0 for size in shape):
            raise EndedError
        left -= math.prod(shape) * np.dtype(dtype).itemsize
        if left < 0:
            raise EndedError
        arrays[name] = np.empty(shape, dtype)
        _fill(process, arrays[name].reshape(-1).view(np.uint8).data)
    return dict(message["answer"]), arrays


def _send(connection: socket.socket, message: dict[str, Any]) -> None:
    text = json.dumps(message, default=np.ndarray.tolist).encode()
    connection.sendall(len(text).to_bytes(HEADER_BYTES, "little") + text)


def _receive(connection: socket.socket, most: int) -> dict[str, Any]:
    header = bytearray(HEADER_BYTES)
    _fill(connection, memoryview(header))
    size = int.from_bytes(header, "little")
    if size > most:
        raise EndedError
    text = bytearray(size)
    _fill(connection, memoryview(text))
    return dict(json.loads(text))


def _fill(connection: socket.socket, target: memoryview) -> None:
    """Fill memory with what comes; raise ``EndedError`` if the other side ends before."""
    while target:
        count = connection.recv_into(target)
        if not count:
            raise EndedError
        target = target[count:]
