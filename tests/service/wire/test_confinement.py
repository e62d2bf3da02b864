"""What a reader of strangers' files can do: read its folder, and nothing else."""

import json
import os
import socket
import sys
from pathlib import Path

import pytest

from service.wire.confinement import available
from tests.fork_server import run
from worker.process import python

TRIALS = """
import ctypes, fcntl, json, os, platform, resource, signal, socket, subprocess, sys, threading
from pathlib import Path
from service.wire.confinement import confine
folder, secret, port, parent = sys.argv[1:]
os.chdir(folder)
was_root = os.geteuid() == 0
libc = ctypes.CDLL(None, use_errno=True)
confine(Path(folder))
numbers = {"x86_64": 0, "aarch64": 1}[platform.machine()]

def called(x86_64, aarch64, *words):
    failing(lambda: libc.syscall((x86_64, aarch64)[numbers], *words))

def failing(call):
    if call() == -1:
        raise OSError(ctypes.get_errno(), "")

trials = {
    "a file elsewhere": lambda: Path(secret).read_bytes(),
    "a folder elsewhere": lambda: os.listdir(Path(secret).parent),
    "writing elsewhere": lambda: Path(secret).write_bytes(b""),
    "a link to it": lambda: os.symlink(secret, "link"),
    "a name for it": lambda: os.link(secret, "name"),
    "the parent's environment": lambda: Path(f"/proc/{parent}/environ").read_bytes(),
    "its own environment": lambda: Path("/proc/self/environ").read_bytes(),
    "the parent's memory": lambda: failing(lambda: libc.ptrace(16, int(parent), 0, 0)),
    "a signal": lambda: os.kill(int(parent), 0),
    "limits of the parent": lambda: resource.prlimit(int(parent), resource.RLIMIT_CPU),
    "the network": lambda: socket.socket().connect(("127.0.0.1", int(port))),
    "a socket": lambda: socket.socket(socket.AF_UNIX),
    "a program": lambda: subprocess.run(["/bin/true"]),
    "a process": os.fork,
    "a thread": threading.Thread(target=print).start,
    "more threads": lambda: called(56, 220, 0x50F00, 0, 0, 0, 0),
    "the mode of a file elsewhere": lambda: os.chmod(secret, 0o777),
    "the mode of the folder": lambda: os.chmod(".", 0o777),
    "the mode of the folder above": lambda: os.chmod("..", 0o777),
    "the mode of an open file": lambda: os.fchmod(0, 0o777),
    "an owner": lambda: os.chown("upload", 0, 0),
    "times of a file": lambda: os.utime("upload"),
    "times of a file elsewhere": lambda: os.utime(secret),
    "an attribute": lambda: os.setxattr("upload", "user.a", b"1"),
    "attributes": lambda: os.listxattr("upload"),
    "what files there are": lambda: os.stat("/etc/shadow"),
    "what a file elsewhere is": lambda: os.stat(secret),
    "a priority": lambda: os.setpriority(os.PRIO_PROCESS, int(parent), 5),
    "its own priority": lambda: os.nice(1),
    "processors of the parent": lambda: os.sched_setaffinity(int(parent), {0}),
    "its own processors": lambda: os.sched_setaffinity(0, {0}),
    "a schedule": lambda: os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0)),
    "a signal to all": lambda: os.kill(-1, 0),
    "a signal by a file": lambda: fcntl.fcntl(0, fcntl.F_SETOWN, int(parent)),
    "a terminal": lambda: fcntl.ioctl(0, 0x5412, b"x"),
    "io_uring": lambda: called(425, 425, 1, bytes(120)),
    "a mount": lambda: called(165, 40, b"/", b"/", b"tmpfs", 0, 0),
    "a namespace": lambda: called(272, 97, 0x10000000),
    "keys": lambda: called(250, 219, 0, -3, 0),
    "bpf": lambda: called(321, 280, 0, bytes(120), 120),
    "other users": lambda: os.setuid(0),
    "groups": lambda: os.setgroups([0]),
    "capabilities": lambda: called(126, 91, bytes(8), bytes(24)),
    "a root": lambda: os.chroot("."),
    "more memory": lambda: resource.setrlimit(resource.RLIMIT_AS, (-1, -1)),
    "a device": lambda: os.mknod("device", 0o600),
    "a pipe with a name": lambda: os.mkfifo("fifo"),
    "memory that others see": lambda: os.memfd_create("shared"),
    "traces": lambda: called(298, 241, bytes(120), 0, -1, -1, 0),
}
if was_root:
    assert os.getuid() == os.getgid() >= 60000
done = []
for name, trial in trials.items():
    try:
        trial()
    except (OSError, ValueError, RuntimeError):
        continue
    done.append(name)
Path("made").write_bytes(b"1")  # what is allowed
assert Path("made").read_bytes() == Path("upload").read_bytes()
os.rename("made", "other")
os.remove("other")
os.mkdir("unpacked")
print(json.dumps(done))
"""


@pytest.mark.skipif(len(available()) < 2, reason="the kernel cannot confine a process")
def test_without_a_folder_it_reads_no_file_at_all(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"1")
    code = """
import sys
from pathlib import Path
from service.wire.confinement import confine
confine(None)
try:
    Path(sys.argv[1]).read_bytes()
except OSError:
    print("refused")
"""
    code = f"import sys; sys.path[:] = {sys.path!r}\n{code}"
    done = run(python("-c", code, str(tmp_path / "file")))
    assert (done.returncode, done.stdout) == (0, "refused\n"), done.stderr


@pytest.mark.skipif(len(available()) < 2, reason="the kernel cannot confine a process")
def test_it_reads_its_folder_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "upload").write_bytes(b"1")
    secret = tmp_path / "secret"
    secret.write_bytes(b"password")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        code = f"import sys; sys.path[:] = {sys.path!r}\n{TRIALS}"
        words = (str(tmp_path / "folder"), str(secret), str(port), str(os.getpid()))
        done = run(python("-c", code, *words))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == []
    assert secret.read_bytes() == b"password"
