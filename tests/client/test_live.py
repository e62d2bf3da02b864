"""Streams passed on live: to VMC, OSC and JSON, from datagrams and lines."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import cli
from fewview.live.bodies import Body
from fewview.live.holding import Holder
from fewview.live.osc import bundles, message
from fewview.live.targets import writer_for
from typer.testing import CliRunner

from tests.client.conftest import Served
from tests.client.faulty import Line
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
    views = [
        [None if np.isnan(point).any() else point.tolist() for point in view]
        for view in served.capture.keypoints[place]
    ]
    return json.dumps({"sequence": 100 + place, "keypoints": views}).encode()


def read_osc(data: bytes) -> list[tuple[str, list[Any]]]:
    """Return the messages of a bundle as the library of others reads them."""
    other = pytest.importorskip("pythonosc.osc_bundle", reason="python-osc is not installed")
    return [(each.address, each.params) for each in other.OscBundle(data)]


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
    lines = [frame(served, 0), *BAD, b"9" * 300_000, BAD[0], frame(served, 1)]
    told = tmp_path / "metrics.jsonl"
    words = command(served, receiver, "udp+json", f"--metrics={told}", "--refine=off")
    ran = CliRunner().invoke(cli.app, words, input=b"\n".join(lines))
    assert ran.exit_code == 0, ran.stderr
    expected = served.client.lift(served.model, served.capture.keypoints[:2], refine="off")
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


def test_datagrams_become_points_until_it_is_interrupted(
    served: Served, receiver: socket.socket
) -> None:
    words = command(served, receiver, "osc", "--from=udp://127.0.0.1:0", "--hold=0", "--fade=0")
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, *words], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        said = process.stderr.readline()
        assert "listening on udp://" in said
        place = ("127.0.0.1", int(said.rsplit(":", 1)[1]))
        receiver.sendto(BAD[0], place)
        receiver.sendto(frame(served, 3), place)
        data = receiver.recv(65536)
        process.send_signal(signal.SIGINT)
        try:
            _, rest = process.communicate(timeout=30)
        finally:
            process.kill()
        assert process.returncode == 0, rest
    assert "a frame is not JSON" in rest
    found = read_osc(data)
    assert {address for address, _ in found} == {"/fewview/point"}
    assert {name for _, (name, *_) in found} <= set(served.capture.keypoint_names or ())
    assert all(np.isfinite(numbers).all() for _, (_, *numbers) in found)


def test_bones_are_sent_as_unity_names_them() -> None:
    holder = Holder(len(REST), hold=1, fade=1)
    pose = holder.take(0, np.array(list(REST.values()), float), None, 0)
    (data,) = writer_for("vmc", list(REST), 1.0)(pose)
    found = read_osc(data)
    assert found[0] == ("/VMC/Ext/OK", [1])
    assert [address for address, _ in found[1:3]] == ["/VMC/Ext/T", "/VMC/Ext/Root/Pos"]
    assert all(address == "/VMC/Ext/Bone/Pos" for address, _ in found[3:])
    names = [params[0] for _, params in found[3:]]
    assert names == ["Hips", "Spine", "LeftUpperArm", "LeftLowerArm"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--to=http://127.0.0.1:1"], "--to: expected vmc://host:port"),
        (["--to=osc://127.0.0.1"], "--to: expected"),
        (["--to=osc://127.0.0.1:1", "--from=tcp://127.0.0.1:1"], "--from: expected udp://"),
        (["--to=vmc://127.0.0.1"], "VMC needs keypoints that are named left_hip"),
        (["--to=osc://127.0.0.1:1", "--up=high"], "--up: expected auto or a vector"),
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
    ):
        asked = ["live", served.model, f"--url={served.live.url}", "--frame=canonical", *words]
        ran = CliRunner().invoke(cli.app, asked)
        assert ran.exit_code == 1
        assert reason in ran.stderr


def turned(points: dict[str, tuple[float, float, float]], **fewer: float) -> dict[str, Any]:
    holder = Holder(len(points), hold=1, fade=1)
    holder.take(0, np.array(list(points.values()), float), None, 0)
    pose = holder.pose(fewer.get("after", 0))
    return {bone.name: bone for bone in Body(list(points)).turned(pose, metres=2)}


REST = {
    "left_shoulder": (-0.2, 1.4, 0),
    "right_shoulder": (0.2, 1.4, 0),
    "left_hip": (-0.1, 0.9, 0),
    "right_hip": (0.1, 0.9, 0),
    "left_elbow": (-0.5, 1.4, 0),
    "left_wrist": (-0.8, 1.4, 0),
}


def test_a_body_at_rest_is_not_turned_and_a_raised_arm_is() -> None:
    """The T looks along Unity's +z; a left arm that points ahead is turned by +90 degrees."""
    rest = turned({**REST, "left_hip": (-0.1, 0.9, 0.5), "right_hip": (0.1, 0.9, 0.5)} | REST)
    assert rest.keys() == {"Hips", "Spine", "LeftUpperArm", "LeftLowerArm"}
    assert rest["Hips"].position == pytest.approx((0, 1.8, 0))
    for bone in rest.values():
        assert bone.rotation == pytest.approx((0, 0, 0, 1), abs=1e-5)
    half = np.sqrt(0.5)
    ahead = {**REST, "left_elbow": (-0.2, 1.4, -0.3), "left_wrist": (-0.2, 1.4, -0.6)}
    arm = turned(ahead)["LeftUpperArm"].rotation
    # In Unity's axes the quaternion must take (-1, 0, 0) to (0, 0, 1).
    assert rotated(arm, (-1, 0, 0)) == pytest.approx((0, 0, 1), abs=1e-5)
    assert abs(arm[1]) == pytest.approx(half, abs=1e-5)
    assert turned(ahead)["LeftLowerArm"].rotation == pytest.approx((0, 0, 0, 1), abs=1e-5)
    about = {name: (-x, y, -z) for name, (x, y, z) in ahead.items()}  # looks the other way
    assert turned(about)["LeftUpperArm"].rotation == pytest.approx(arm, abs=1e-5)
    assert rotated(turned(about)["Hips"].rotation, (0, 0, 1)) == pytest.approx((0, 0, -1), abs=1e-5)


def test_what_is_missing_is_held_then_turns_back_to_rest_then_is_gone() -> None:
    ahead = {**REST, "left_elbow": (-0.2, 1.4, -0.3), "left_wrist": (-0.2, 1.4, -0.6)}
    angles = [
        np.degrees(2 * np.arccos(turned(ahead, after=after)["LeftUpperArm"].rotation[3]))
        for after in (0.9, 1.5)
    ]
    assert angles == pytest.approx([90, 45], abs=0.001)
    assert turned(ahead, after=2) == {}


def rotated(quaternion: tuple[float, ...], vector: tuple[float, ...]) -> Any:
    """Turn a vector by a quaternion x, y, z, w as Unity does: v + 2 q x (q x v + w v)."""
    axis, w = np.array(quaternion[:3]), quaternion[3]
    return np.array(vector) + 2 * np.cross(axis, np.cross(axis, vector) + w * np.array(vector))


def test_messages_are_read_by_the_library_of_others() -> None:
    sent: list[tuple[str, list[str | int | float]]] = [
        (f"/fewview/{'x' * length}", ["é" * length, length, 0.5]) for length in range(60)
    ]
    found = []
    for data in bundles(message(address, *values) for address, values in sent):
        assert len(data) <= 1400
        found += read_osc(data)
    assert found == sent
