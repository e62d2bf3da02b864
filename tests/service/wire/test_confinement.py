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
import ctypes, json, os, resource, socket, subprocess, sys, threading
from pathlib import Path
from service.wire.confinement import confine
folder, secret, port, parent = sys.argv[1:]
os.chdir(folder)
confine(Path(folder))
libc = ctypes.CDLL(None, use_errno=True)

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
    "the network": lambda: socket.create_connection(("127.0.0.1", int(port))),
    "a socket": lambda: socket.socket(socket.AF_UNIX),
    "a program": lambda: subprocess.run(["/bin/true"]),
    "a process": os.fork,
}
done = []
for name, trial in trials.items():
    try:
        trial()
    except OSError:
        continue
    done.append(name)
Path("made").write_bytes(b"1")  # what is allowed
assert Path("made").read_bytes() == Path("upload").read_bytes()
os.rename("made", "other")
os.remove("other")
os.mkdir("unpacked")
thread = threading.Thread(target=lambda: done.append("thread"))
thread.start()
thread.join()
import wave  # of Python's own library
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
except PermissionError:
    print("refused")
import wave
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
    assert json.loads(done.stdout) == ["thread"]
    assert secret.read_bytes() == b"password"
