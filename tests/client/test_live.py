"""Streams passed on live: to VMC, OSC and JSON, from datagrams and lines."""

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from fewview import cli
from typer.testing import CliRunner

from tests.client.conftest import Served
from tests.client.faulty import Line
from tests.client.osc import read_osc
from tests.processes import free_port

BAD = [
    b"not JSON",
    b"[" * 100_000,
    b"\x80\x05K\x01.",  # of pickle
    b'{"sequence": 1, "keypoints": [[[1, 2]]]}',
    b'{"sequence": 1, "keypoints": [[["a", 2]]]}',
    b'{"sequence": -1, "keypoints": []}',
]


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(300)
        yield udp


def frame(served: Served, place: int) -> bytes:
    keypoints = served.capture.keypoints[place % len(served.capture.keypoints)]
    views = [
        [None if np.isnan(point).any() else point.tolist() for point in view] for view in keypoints
    ]
    return json.dumps({"sequence": 100 + place, "keypoints": views}).encode()


FRAMES = 800

# Shells that put a command in the background have its children ignore interrupts.
INTERRUPTIBLE = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from fewview.cli import main
main()
"""


def command(served: Served, udp: socket.socket, scheme: str, *more: str) -> list[str]:
    to = f"--to={scheme}://127.0.0.1:{udp.getsockname()[1]}"
    url = () if any(each.startswith("--url") for each in more) else (f"--url={served.live.url}",)
    return ["live", served.model, to, "--frame=canonical", *url, *more]


def test_lines_become_json_and_bad_ones_are_counted(
    served: Served, receiver: socket.socket, tmp_path: Path
) -> None:
    one = json.loads(frame(served, 1))
    one["keypoints"][2] = None  # nobody is in that view
    one = json.dumps(one).encode()
    lines = [frame(served, 0), *BAD, b"9" * 300_000, BAD[0], one]
    told = tmp_path / "metrics.jsonl"
    words = command(served, receiver, "udp+json", f"--metrics={told}", "--refine=off")
    ran = CliRunner().invoke(cli.app, words, input=b"\n".join(lines))
    assert ran.exit_code == 0, ran.stderr
    keypoints = served.capture.keypoints[:2].copy()
    keypoints[1, 2] = np.nan
    expected = served.client.lift(served.model, keypoints, refine="off")
    for place in range(2):
        sent = json.loads(receiver.recv(65536))
        while sent["sequence"] != 100 + place:  # those before may be repeated
            sent = json.loads(receiver.recv(65536))
        points = {point["name"]: point for point in sent["points"]}
        for name, known in zip(
            served.capture.keypoint_names or (), expected.points3d[place], strict=True
        ):
            if np.isfinite(known).all():
                np.testing.assert_allclose(points[name]["position"], known, rtol=1e-3, atol=1e-3)
                assert points[name]["weight"] == 1
                assert points[name]["sd"] is None or points[name]["sd"] > 0
    records = [json.loads(line) for line in told.read_text().splitlines()]
    assert sum(record["frames"] for record in records) == 2
    assert records[-1]["bad"] == len(BAD) + 2
    assert ran.stderr.count("a frame is not JSON") == 1
    assert "expected views of 16 keypoints" in ran.stderr


def test_by_default_points_are_those_of_a_room_that_the_model_must_have(
    served: Served, receiver: socket.socket
) -> None:
    words = [each for each in command(served, receiver, "osc") if each != "--frame=canonical"]
    ran = CliRunner().invoke(cli.app, words, input=frame(served, 0))
    assert ran.exit_code == 1
    assert "has no room: none of its cameras is static" in ran.stderr
    assert "frame=canonical" in ran.stderr


def test_a_stream_that_breaks_is_opened_anew(
    served: Served, receiver: socket.socket, tmp_path: Path
) -> None:
    host, port = served.live.url.removeprefix("http://").split(":")
    line = Line((host, int(port)), free_port(), faults=[(b"GET /lift/stream", 3000)])
    told = tmp_path / "metrics.jsonl"
    words = command(served, receiver, "udp+json", f"--url={line.url}", f"--metrics={told}")
    with line.open():
        # More than can be under way when the stream breaks: some are left for the next.
        lines = [frame(served, place) for place in range(40)] * (FRAMES // 40)
        ran = CliRunner().invoke(cli.app, words, input=b"\n".join(lines))
    assert ran.exit_code == 0, ran.stderr
    records = [json.loads(line) for line in told.read_text().splitlines()]
    assert records[-1]["reconnects"] == 1
    assert sum(record["frames"] for record in records) + records[-1]["dropped"] == FRAMES
    assert sum(each.count(b"GET /lift/stream") for each in line.asked) == 2


@contextmanager
def running(words: list[str]) -> Iterator["subprocess.Popen[str]"]:
    python = [sys.executable, "-c", INTERRUPTIBLE, *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(python, stdin=pipe, stderr=pipe, text=True, bufsize=1) as process:
        try:
            yield process
        finally:
            process.kill()


def read_until(process: "subprocess.Popen[str]", words: str) -> str:
    """Return the next line on stderr that matches."""
    assert process.stderr is not None
    return next(line for line in process.stderr if re.search(words, line))


def address_of(process: "subprocess.Popen[str]") -> tuple[str, int]:
    return "127.0.0.1", int(read_until(process, "listening on udp://").rsplit(":", 1)[1])


def test_datagrams_become_points_until_it_is_interrupted(
    served: Served, receiver: socket.socket
) -> None:
    """One that a later one has overtaken on its way is dropped."""
    words = command(served, receiver, "osc", "--from=udp://localhost:0", "--hold=0", "--fade=0")
    with running(words) as process:
        place = address_of(process)
        receiver.sendto(BAD[0], place)
        receiver.sendto(frame(served, 4), place)
        data = receiver.recv(65536)
        for number in (3, 5):
            receiver.sendto(frame(served, number), place)
        receiver.recv(65536)
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=30)
        assert process.returncode == 0, rest
    assert "a frame is not JSON" in rest
    assert "1 bad, 1 dropped" in rest
    found = read_osc(data)
    assert {address for address, _ in found} == {"/fewview/point"}
    assert {name for _, (name, *_) in found} <= set(served.capture.keypoint_names or ())
    assert all(np.isfinite(numbers).all() for _, (_, *numbers) in found)


def test_an_interrupt_ends_it_while_it_waits_for_a_line(
    served: Served, receiver: socket.socket
) -> None:
    """A disk that is full ends the file of figures, and nothing else."""
    with running(command(served, receiver, "osc", "--metrics=/dev/full")) as process:
        assert "No space left on device" in read_until(process, "--metrics: ")
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=30)
        assert process.returncode == 0, rest


def test_a_model_that_is_deleted_ends_it(
    served: Served, receiver: socket.socket, tmp_path: Path
) -> None:
    weights = served.client.models.download(served.model, tmp_path / "model.safetensors")
    words = command(served, receiver, "udp+json")
    words[1] = copy = served.client.models.upload(weights).id
    with running(words) as process:
        assert process.stdin is not None
        process.stdin.write(f"{frame(served, 0).decode()}\n")
        receiver.recv(65536)
        served.client.models.delete(copy)
        with suppress(BrokenPipeError):
            while process.poll() is None:
                process.stdin.write(f"{frame(served, 1).decode()}\n")
                time.sleep(0.05)
        _, rest = process.communicate(timeout=30)
        assert process.returncode == 2, rest
    assert f"There is no model '{copy}'" in rest


def test_frames_wait_for_a_slow_service_where_newer_ones_replace_them(
    served: Served, receiver: socket.socket
) -> None:
    sent = 100
    host, port = served.live.url.removeprefix("http://").split(":")
    line = Line((host, int(port)), free_port())
    words = command(served, receiver, "udp+json", f"--url={line.url}", "--from=udp://127.0.0.1:0")
    with line.open(), running(words) as process:
        place = address_of(process)
        receiver.sendto(frame(served, 0), place)
        receiver.recv(65536)
        line.open_back.clear()
        for number in range(1, sent):
            receiver.sendto(frame(served, number), place)
        read_until(process, "(8|9)[0-9] dropped")
        line.open_back.set()
        while json.loads(receiver.recv(65536))["sequence"] != 100 + sent - 1:
            pass


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--to=http://127.0.0.1:1"], "--to: expected vmc://host:port"),
        (["--to=osc://127.0.0.1"], "--to: expected"),
        (["--to=osc://127.0.0.1:1", "--from=tcp://127.0.0.1:1"], "--from: expected udp://"),
        (["--to=vmc://127.0.0.1"], "VMC needs keypoints that are named left_hip"),
        (["--to=osc://127.0.0.1:1", "--up=high"], "--up: expected auto or a vector"),
        (["--to=osc://127.0.0.1:1", "--up=0,0,nan"], "--up: expected auto or a vector"),
        (["--to=osc://127.0.0.1:1", "--up=auto", "--frame=canonical"], "--up: only with --frame"),
        (["--to=osc://127.0.0.1:1", "--fps=30"], "--fps: only with --lag"),
        (["--to=osc://127.0.0.1:1", "--hold=nan"], "expected a finite number"),
        (["--to=osc://me@127.0.0.1:1"], "--to: expected"),
    ],
)
def test_what_is_asked_wrongly_is_refused(served: Served, words: list[str], reason: str) -> None:
    asked = ["live", served.model, f"--url={served.live.url}", *words]
    ran = CliRunner().invoke(cli.app, asked)
    assert ran.exit_code == 2
    assert reason in ran.stderr


def test_an_address_that_cannot_be_used_is_named_with_its_option(
    served: Served, receiver: socket.socket
) -> None:
    taken = f"--from=udp://127.0.0.1:{receiver.getsockname()[1]}"
    for words, reason in (
        (["--to=osc://127.0.0.1:1", taken], "--from: 127.0.0.1 port"),
        (["--to=osc://nowhere.invalid:1"], "--to: nowhere.invalid port 1"),
        (["--to=osc://a..b:1"], "--to: a..b port 1"),
        (["--to=osc://127.0.0.1:0"], "--to: 127.0.0.1 port 0"),
    ):
        asked = ["live", served.model, f"--url={served.live.url}", "--frame=canonical", *words]
        ran = CliRunner().invoke(cli.app, asked)
        assert ran.exit_code == 1
        assert reason in ran.stderr
