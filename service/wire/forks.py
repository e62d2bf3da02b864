"""Processes for the bodies of untrusted clients, so that this process stays free for others.

Functions in C, such as JSON parsers, often block all other threads of their process until they end.
Starting another process takes long, however. So one process is kept that has imported all that is
needed, and forks another one for each body. That one is confined, bounded in memory and time, and
ends with its answer. None outlives the process that uses it.
"""

import atexit
import gc
import json
import math
import os
import signal
import socket
import subprocess
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from service.wire.arrays import Arrays
from service.wire.children import child_code, child_environment, limit
from service.wire.confinement import confine
from worker.process import die_with_parent, python

SECONDS = 60  # of processor time for one body
PATIENCE_SECONDS = 120.0  # between two signs of life of a process
OWN_BYTES = 2**30  # addresses that Python and its libraries take
NICENESS = 5  # so that others go on with what is quick
HEADER_BYTES = 8  # the length of the JSON that begins each message, little-endian
DTYPES = ("<f4", "<f8")
LONGEST_ANSWER = 16 * 2**20  # bytes of JSON: what is valid of a body beside its arrays is little
LONGEST_NAME = 200

Work = Callable[[dict[str, Any], bytearray], tuple[dict[str, Any], Arrays]]


class EndedError(Exception):
    """A process ended without an answer."""


class Forks:
    """Forks processes that do one piece of work each.

    Parameters
    ----------
    module
        Where the work is: its function ``work`` is given JSON and bytes, and returns JSON and
        arrays.
    """

    def __init__(self, module: str) -> None:
        self._module, self._lock = module, threading.Lock()
        self._server: _Server | None = None

    def work(
        self, needed: str, asked: dict[str, Any], data: bytes, *, max_bytes: int
    ) -> tuple[dict[str, Any], Arrays]:
        """Have a new process do the work.

        Parameters
        ----------
        needed
            A module that it imports, once for all.
        max_bytes
            Addresses that it may take beside its own.

        Raises
        ------
        EndedError
            If it ends without an answer, does not answer in time, or answers with more than it may
            have, or with what no answer is: what it has read may have taken it over.
        """
        header = {"asked": asked, "size": len(data), "max_bytes": max_bytes}
        server = self._running()
        try:
            return server.work(needed, header, data)
        except EndedError:
            if not server.has_ended():
                raise
        return self._running().work(needed, header, data)  # it was killed, and not by this body

    def _running(self) -> "_Server":
        with self._lock:
            if self._server is not None and self._server.has_ended():
                self._server.stop()
                self._server = None
            if self._server is None:
                self._server = _Server(self._module)
            return self._server


class _Server:
    """The process that forks; it ends when this process closes its end, however it does."""

    def __init__(self, module: str) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        code = child_code(
            "import socket",
            f"from {__name__} import serve",
            f"from {module} import work",
            f"serve(socket.socket(fileno={theirs.fileno()}), work)",
        )
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 (our own program)
                python("-c", code),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=child_environment(),
                start_new_session=True,  # Ctrl-C is for this process
            )
        self._owner = os.getpid()
        atexit.register(self.stop)

    def work(
        self, needed: str, header: dict[str, Any], data: bytes
    ) -> tuple[dict[str, Any], Arrays]:
        """Have a new process do the work."""
        ours, theirs = socket.socketpair()
        with ours:
            ours.settimeout(PATIENCE_SECONDS)
            try:
                with theirs:
                    socket.send_fds(self._channel, [needed.encode()], [theirs.fileno()])
                _send(ours, header)
                ours.sendall(data)
                return _receive_answer(ours, header["max_bytes"])
            except (OSError, LookupError, TypeError, ValueError, RecursionError) as error:
                raise EndedError from error

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


def serve(channel: socket.socket, work: Work) -> None:
    """Fork a process for each request, until the parent has closed its end."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # ended children need no wait
    parent = os.getpid()
    while True:
        data, descriptors, _, _ = socket.recv_fds(channel, LONGEST_NAME, 1)
        if not data:
            return
        __import__(data.decode())
        gc.disable()  # what a process leaves goes with it, and to search for it takes long
        with socket.socket(fileno=descriptors[0]) as connection, suppress(OSError):
            if os.fork() == 0:
                channel.close()
                _serve_one(connection, parent, work)


def _serve_one(connection: socket.socket, parent: int, work: Work) -> None:
    """Do one piece of work, and end this process."""
    try:
        die_with_parent(parent)
        os.nice(NICENESS)
        given = _receive(connection, LONGEST_ANSWER)
        limit(OWN_BYTES + given["max_bytes"], SECONDS)
        confine(None)
        data = bytearray(given["size"])
        _fill(connection, memoryview(data))
        answer, arrays = work(given["asked"], data)
        shapes = {n: (a.dtype.str, a.shape) for n, a in arrays.items()}
        _send(connection, {"answer": answer, "arrays": shapes})
        for array in arrays.values():
            connection.sendall(np.ascontiguousarray(array).data.cast("B"))
    except BaseException:  # noqa: BLE001 (no caller above reports it)
        traceback.print_exc()
    finally:
        os._exit(0)


def _receive_answer(process: socket.socket, max_bytes: int) -> tuple[dict[str, Any], Arrays]:
    """Return an answer, whose arrays have so many bytes at most, together."""
    message = _receive(process, LONGEST_ANSWER)
    arrays: Arrays = {}
    left = max_bytes
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
    text = json.dumps(message).encode()
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
