"""What a process that works for strangers can do: its work, within limits, in its folder.

What it answers is not trusted: the file or body that it reads may have taken it over.
"""

import json
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fewview.errors import FormatError
from fewview.readers.large_arrays import LARGE
from fewview.reading_options import ReadingOptions

from service.wire import reading_apart
from service.wire.confinement import available
from service.wire.reading_apart import read_apart
from service.wire.sandbox import EndedError, LateError, Limits, Sandbox, shared
from tests.client.readers import files
from tests.fork_server import run
from tests.processes import descendants
from tests.service.conftest import zip_of
from tests.service.wire import sandboxed
from tests.waiting import wait_for
from worker.process import python

LIMITS = Limits(memory=2**28, arrays=2**20, file=2**16)
WORK = [sandboxed.__name__]


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    made = Sandbox()
    yield made
    made.stop()


@pytest.mark.parametrize("lie", sandboxed.LIES)
def test_an_answer_of_more_than_may_come_is_none(sandbox: Sandbox, lie: str) -> None:
    with pytest.raises(EndedError):
        sandbox.work(WORK, {"lie": lie}, limits=LIMITS)
    answer, arrays = sandbox.work(WORK, {}, b"abc", limits=LIMITS)
    assert answer["came"] == 3
    assert arrays["a"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("name", ["memory", "file"])
def test_it_gets_as_much_as_it_may_and_no_more(sandbox: Sandbox, tmp_path: Path, name: str) -> None:
    most = getattr(LIMITS, name)
    asked = {name: most // 2}
    sandbox.work(WORK, asked, limits=LIMITS, folder=tmp_path)
    assert [path.stat().st_size for path in tmp_path.iterdir()] == [most // 2] * (name == "file")
    with pytest.raises(EndedError):
        sandbox.work(WORK, {name: 8 * most}, limits=LIMITS, folder=tmp_path)


def test_what_takes_too_long_is_killed(sandbox: Sandbox) -> None:
    sandbox.work(WORK, {}, limits=LIMITS)
    before = descendants(os.getpid())
    with pytest.raises(LateError):
        sandbox.work(WORK, {"seconds": 60}, limits=LIMITS._replace(seconds=0.5))
    wait_for(lambda: descendants(os.getpid()) <= before, "the end of what was late", 20)


def test_it_knows_no_passwords(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FEWVIEW_DATABASE_URL", "AWS_SECRET_ACCESS_KEY", "PGPASSWORD"):
        monkeypatch.setenv(name, "secret-of-the-service")
    fresh = Sandbox()
    answer, _ = fresh.work(WORK, {}, limits=LIMITS)
    fresh.stop()
    assert answer["environment"]["OMP_NUM_THREADS"] == "1"
    assert "secret-of-the-service" not in answer["environment"].values()


def test_files_of_strangers_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = files.walk(12).reshape(12, -1)
    files.dlc_csv(tmp_path / "numpy.py", files.columns(files.NAMES), table)
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as of `python -c`
    shared.stop()  # it starts with these paths
    assert read_apart(tmp_path, ["numpy.py"], ReadingOptions(), max_bytes=2**20).frames == 12
    shared.stop()


@pytest.mark.thorough
def test_large_arrays_lie_in_the_folder_of_the_upload(tmp_path: Path) -> None:
    frames = 1 + LARGE // (24 * 4)  # of 24 numbers
    names = ",".join(f"{axis}{k}" for k in range(8) for axis in ("x", "y", "confidence"))
    rows = ",".join(["5", "7", "1"] * 8) + "\n"
    (tmp_path / "a.csv").write_text(f"{names}\n{rows * frames}")
    found = read_apart(tmp_path, ["a.csv"], ReadingOptions(), max_bytes=2**30)
    assert found.keypoints.shape == (frames, 1, 8, 2)
    assert (found.keypoints == (5, 7)).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_what_was_unpacked_goes_even_if_reading_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary, folder = tmp_path / "temporary", tmp_path / "folder"
    temporary.mkdir()
    folder.mkdir()
    frame = json.dumps({"people": [{"pose_keypoints_2d": [5, 7, 1] * 25}]}).encode()
    (folder / "a.zip").write_bytes(
        zip_of({f"cam/cam_{n:012}_keypoints.json": frame for n in range(12)})
    )
    os.mkfifo(folder / "b")  # which nobody writes to
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(reading_apart, "SECONDS", 3)
    with pytest.raises(FormatError, match="took more than"):
        read_apart(folder, ["a.zip", "b"], ReadingOptions(), max_bytes=2**20)
    assert list(folder.glob("fewview-*"))
    assert not list(temporary.iterdir())


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
