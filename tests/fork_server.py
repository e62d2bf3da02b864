"""Processes of ours that start at once: forked from one that has imported all they need.

A test process has a fork server, its child, which imports what the parts of a service import and
waits. `Popen` has it fork where the command is one of this Python's, and starts every other command
as usual. What is forked is a process like any other: it is a child of the one that asked, has its
own identifier, arguments, descriptors and environment, and is killed, frozen and waited for as
usual. It runs as `__main__` what the command names. So does what a forked `fewview serve` starts.

What differs from a start from nothing: modules were imported in the server, whose environment and
working directory they saw, and they are not undone as it ends. Tests of that start commands with
`subprocess`.
"""

import atexit
import ctypes
import gc
import json
import os
import runpy
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from worker.process import die_with_parent, python

# What workers, their jobs and services import sooner or later.
MODULES = (
    "fewview.readers.reading",
    "models.training.trainer",
    "service.app",
    "service.health_check",
    "service.keeping",
    "service.process.supervisor",
    "worker.fitting",
    "worker.housekeeping",
    "worker.lifting",
    "worker.rooms",
    "worker.runner",
)
STARTS_OTHERS = {"serve", "run"}  # commands of `fewview`; scripts do, too
PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
LONGEST_REQUEST = 1 << 18  # bytes
MOST_DESCRIPTORS = 32
FREE_DESCRIPTORS = 200  # numbers from here on, that nothing uses
ROOM_FOR_ARGUMENTS = 1 << 13  # bytes, so that a forked process can show its own command
# What `subprocess.Popen` passes on to its method that starts a process.
NAMES = tuple(signature(subprocess.Popen._execute_child).parameters)[1:]  # type: ignore[attr-defined]
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Request:
    """What to run.

    Attributes
    ----------
    parent
        The process that asked.
    descriptors
        The numbers that the descriptors sent along shall have.
    mask
        What new files are not to be allowed (umask(2)).
    """

    parent: int
    command: list[str]
    directory: str
    environment: dict[str, str]
    descriptors: list[int]
    new_session: bool
    mask: int


class ForkServer:
    """The side of a fork server that asks; the server ends with the process that made it."""

    def __init__(self, channel: socket.socket) -> None:
        # Orphans come to this process: the server leaves behind what it forks for it.
        _libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._channel = channel
        self.owner = os.getpid()

    @classmethod
    def start(cls) -> "ForkServer":
        """Start a server as a new process."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = python("-m", "tests.fork_server", str(os.getpid()), str(theirs.fileno()))
        with theirs:
            process = subprocess.Popen(
                [*command, " " * ROOM_FOR_ARGUMENTS],
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C is for the tests
            )
        process.returncode = 0  # nobody waits for it
        return cls(ours)

    def run(self, request: Request, descriptors: list[int]) -> int:
        """Have a command run, as a child of this process; return its identifier."""
        data = json.dumps(asdict(request)).encode()
        socket.send_fds(self._channel, [data], descriptors)
        return int(self._channel.recv(32))

    def end_with_this_process(self, pid: int) -> None:
        """Wait for the server as this process ends, or it would be seen for a moment longer."""

        def end() -> None:
            self._channel.close()
            os.waitpid(pid, 0)

        atexit.register(end)


class Popen(subprocess.Popen[Any]):
    """`subprocess.Popen`, which has commands of this Python's forked from the server."""

    server: ForkServer | None = None

    def _execute_child(self, *arguments: Any) -> None:
        parameters = dict(zip(NAMES, arguments, strict=True))
        command = [os.fspath(word) for word in parameters["args"]]
        if command[: len(python())] != python():
            super()._execute_child(*arguments)  # type: ignore[misc]
            return
        if Popen.server is None or Popen.server.owner != os.getpid():
            Popen.server = ForkServer.start()
        streams = {0: parameters["p2cread"], 1: parameters["c2pwrite"], 2: parameters["errwrite"]}
        given = {number: number if fd == -1 else fd for number, fd in streams.items()}
        given |= {fd: fd for fd in parameters["pass_fds"]}
        request = Request(
            os.getpid(),
            command,
            str(Path(parameters["cwd"] or ".").resolve()),
            dict(os.environ if parameters["env"] is None else parameters["env"]),
            list(given),
            parameters["start_new_session"],
            _mask(),
        )
        self.pid = Popen.server.run(request, list(given.values()))
        self._child_created = True
        ends = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(parameters[end] for end in ends))  # type: ignore[attr-defined]


def _mask() -> int:
    mask = os.umask(0o077)  # which can only be read by changing it
    os.umask(mask)
    return mask


def run(
    command: Sequence[str], *, timeout: float = 300, **options: Any
) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end, and return what it printed as text.

    A command that takes longer than `timeout` seconds is killed: ``subprocess.TimeoutExpired``.
    """
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with Popen(command, **(streams | options)) as process:
        try:
            out, err = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def serve(channel: socket.socket) -> tuple[Request, list[int]]:
    """Fork as asked, until nobody can ask any more; return in forked processes alone."""
    while True:
        data, descriptors, _, _ = socket.recv_fds(channel, LONGEST_REQUEST, MOST_DESCRIPTORS)
        if not data:
            os._exit(0)
        reading, writing = os.pipe()
        if not (between := os.fork()):
            if pid := os.fork():
                os.write(writing, str(pid).encode())
                os._exit(0)  # so that its child comes to the process that asked
            for fd in (reading, writing):
                os.close(fd)
            channel.close()
            return Request(**json.loads(data)), descriptors
        os.waitpid(between, 0)
        channel.send(os.read(reading, 32))
        for fd in (reading, writing, *descriptors):
            os.close(fd)


def fork_server() -> ForkServer | tuple[Request, list[int]]:
    """Fork a server from this process; what it forks returns from here, too."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    parent = os.getpid()
    if pid := os.fork():
        theirs.close()
        server = ForkServer(ours)
        server.end_with_this_process(pid)
        return server
    ours.close()
    die_with_parent(parent)
    return serve(theirs)


def take_place(request: Request, descriptors: list[int]) -> None:
    """Give this process, which was just forked, all that it would have if it had been started."""
    while os.getppid() != request.parent:
        time.sleep(0.0005)
    os.chdir(request.directory)
    os.environ.clear()
    os.environ.update(request.environment)
    os.umask(request.mask)
    if request.new_session:
        os.setsid()
    for number, fd in enumerate(descriptors, FREE_DESCRIPTORS):
        os.dup2(fd, number)
        os.close(fd)
    for number, wanted in enumerate(request.descriptors, FREE_DESCRIPTORS):
        os.dup2(number, wanted)
        os.close(number)
    show(request.command)


def starts_others(command: list[str]) -> bool:
    return bool(STARTS_OTHERS & set(command)) or any(map(is_script, command))


def is_script(word: str) -> bool:
    return word.endswith(".py")


def show(command: list[str]) -> None:
    """Have the system show this command as that of this process (proc_pid_cmdline(5))."""
    begin, end = map(int, Path("/proc/self/stat").read_text().rpartition(")")[2].split()[45:47])
    words = b"\0".join(map(os.fsencode, command))[: end - begin - 1]
    ctypes.memmove(begin, words.ljust(end - begin, b"\0"), end - begin)


def execute(command: list[str]) -> None:
    """Run a command of this Python's in this process, or become another program."""
    words = command
    while words[: len(python())] == python():
        given = words[len(python()) :]
        if is_script(given[0]):
            sys.argv[:] = given
            sys.path.insert(0, str(Path(given[0]).parent))  # where its neighbours lie
            runpy.run_path(given[0], run_name="__main__")
            return
        option, name, *arguments = given
        if (option, name) == ("-m", "worker.process"):  # which becomes what follows
            die_with_parent(int(arguments[0]))
            words = arguments[1:]
            show(words)
            continue
        sys.argv[:] = [option, *arguments]
        if option == "-m":
            sys.modules.pop(name, None)
            runpy.run_module(name, run_name="__main__", alter_sys=True)
        else:
            exec(compile(name, "<string>", "exec"), {"__name__": "__main__"})  # noqa: S102 (-c)
        return
    os.execv(words[0], words)  # noqa: S606


def status_of(command: list[str]) -> int:
    """Run a command to its end in this process, and return the status that Python ends with."""
    try:
        execute(command)
    except SystemExit as leaving:
        if leaving.code is None or isinstance(leaving.code, int):
            return leaving.code or 0
        print(leaving.code, file=sys.stderr)
        return 1
    except Exception:  # noqa: BLE001 (as Python does)
        sys.excepthook(*sys.exc_info())
        return 1
    return 0


def leave(status: int) -> None:
    """End this process as Python ends, but leave its modules alone: to undo them takes 0.3 s."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if stream is not None and not stream.closed:
            stream.flush()
    os._exit(status)


def main() -> None:
    """Import everything, wait for requests, and in the processes that are forked do as they say."""
    parent, channel = int(sys.argv[1]), socket.socket(fileno=int(sys.argv[2]))
    die_with_parent(parent)
    gc.disable()
    for module in MODULES:
        import_module(module)
    import_module("models.numerics.compiled").load_machine_code()
    gc.freeze()  # or a collection would copy all of it
    gc.enable()
    request, descriptors = serve(channel)
    while True:
        take_place(request, descriptors)
        if not starts_others(request.command):
            break
        forked = fork_server()
        if isinstance(forked, ForkServer):
            Popen.server = forked
            subprocess.Popen = Popen  # type: ignore[misc]
            break
        request, descriptors = forked
    leave(status_of(request.command))


if __name__ == "__main__":
    main()
