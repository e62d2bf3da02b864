"""How long `fewview live` takes from a frame's keypoints to its 3D, alone and beside a fit.

    python -m benchmarks.live [--rates 30 60 120] [--to udp+json vmc osc] [--seconds 10]

A service with one worker, the bridge and both ends of it run on this machine. Frames of three views
are sent over UDP at the pace of cameras. A latency is the time from sending a frame
until its 3D has come: JSON names the frame; of VMC and OSC the first datagram that follows a frame
counts. `frames` are those that came.
"""

import argparse
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import Capture, studio
from benchmarks.figures import Bar, print_table
from benchmarks.service_rig import Service, service
from models.capture.synthetic import EDGES, IMAGE_SIZE, KEYPOINT_NAMES

P99_MS, RATE = 12.0, 60
GRACE_SECONDS = 0.5
QUICK = {"steps": 300, "cameras": "static"}
LONG = {"steps": 1_000_000}
HOST = "127.0.0.1"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure the latency of fewview live.")
    parser.add_argument("--rates", type=int, nargs="+", default=[30, 60, 120], help="frames/s")
    parser.add_argument("--to", nargs="+", default=["udp+json", "vmc", "osc"], help="schemes")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement")
    arguments = parser.parse_args()
    capture = studio(3, len(KEYPOINT_NAMES), frames=100)
    rows = []
    with service("--workers", "1") as running:
        body = {
            "keypoints": _plain(capture),
            "image_sizes": [list(IMAGE_SIZE)] * 3,
            "skeleton": {"keypoint_names": KEYPOINT_NAMES, "edges": EDGES},
        }
        dataset = running.client.post("/datasets", json=body).raise_for_status().json()["id"]
        fit, _ = running.run("/fits", {"dataset_id": dataset, "config": QUICK})
        for beside in (False, True):
            with _fit_beside(running, dataset) if beside else _nothing():
                for scheme in arguments.to:
                    for rate in arguments.rates:
                        model = fit["model_id"]
                        found = measured(running, model, capture, scheme, rate, arguments.seconds)
                        rows.append({"beside a fit": "yes" if beside else "no"} | found)
                        print(rows[-1], flush=True)
    print_table("From keypoints to 3D", rows)
    bars = [
        Bar(f"{row['to']}, {RATE} frames/s beside a fit, p99", P99_MS, row["p99, ms"], "ms").row()
        for row in rows
        if row["frames/s"] == RATE and row["beside a fit"] == "yes"
    ]
    print_table("Bars", bars)


def measured(
    running: Service, model: str, capture: Capture, scheme: str, rate: int, seconds: float
) -> dict[str, Any]:
    """Send frames through a bridge for some seconds, and return how long they took."""
    frames = _plain(capture)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind((HOST, 0))
        receiver.settimeout(0.1)
        with _bridge(running, model, f"{scheme}://{HOST}:{receiver.getsockname()[1]}") as port:
            target = (HOST, port)
            _until_it_answers(sender, receiver, target, frames[0])
            sent: list[float] = []
            came: dict[int, float] = {}
            ended = threading.Event()

            def receive() -> None:
                while not ended.is_set():
                    try:
                        data = receiver.recv(65536)
                    except TimeoutError:
                        continue
                    now = time.perf_counter()
                    named = json.loads(data)["sequence"] if scheme == "udp+json" else len(sent) - 1
                    if named is not None and named >= 0:
                        came.setdefault(named, now)

            thread = threading.Thread(target=receive)
            thread.start()
            begun = time.perf_counter()
            for number in range(int(seconds * rate)):
                time.sleep(max(0.0, begun + number / rate - time.perf_counter()))
                body = {"sequence": number, "keypoints": frames[number % len(frames)]}
                data = json.dumps(body).encode()
                sent.append(time.perf_counter())
                sender.sendto(data, target)
            time.sleep(GRACE_SECONDS)
            ended.set()
            thread.join()
    took = 1000 * np.array([came[number] - at for number, at in enumerate(sent) if number in came])
    p50, p99 = np.quantile(took, (0.5, 0.99))
    return {
        "to": scheme,
        "frames/s": rate,
        "sent": len(sent),
        "frames": len(took),
        "p50, ms": round(float(p50), 2),
        "p99, ms": round(float(p99), 2),
        "most, ms": round(float(took.max()), 2),
    }


def _plain(capture: Capture) -> list[Any]:
    """Return the keypoints as JSON has them; all are seen."""
    frames: list[Any] = capture.keypoints.tolist()
    return frames


@contextmanager
def _bridge(running: Service, model: str, to: str) -> Iterator[int]:
    """Run the bridge as a process, and yield the port it listens on."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind((HOST, 0))
        port = int(free.getsockname()[1])
    command = [str(Path(sys.executable).with_name("fewview")), "live", model]
    command += ["--from", f"udp://{HOST}:{port}", "--to", to, "--url", running.address]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)  # noqa: S603
    try:
        yield port
    finally:
        process.terminate()
        process.wait()


def _until_it_answers(
    sender: socket.socket, receiver: socket.socket, target: tuple[str, int], frame: Any
) -> None:
    """Send a frame until something comes, and read all that does."""
    for _ in range(300):
        sender.sendto(json.dumps({"sequence": 0, "keypoints": frame}).encode(), target)
        try:
            receiver.recv(65536)
            break
        except TimeoutError:
            continue
    else:
        raise RuntimeError("the bridge did not answer")
    try:
        for _ in range(1000):
            receiver.recv(65536)
    except TimeoutError:
        pass


@contextmanager
def _fit_beside(running: Service, dataset: str) -> Iterator[None]:
    """Have the worker fit for as long as the block takes."""
    body = {"dataset_id": dataset, "config": LONG}
    fit = running.client.post("/fits", json=body).raise_for_status().json()["id"]
    while not running.client.get(f"/fits/{fit}").json()["progress"]:
        time.sleep(0.2)
    try:
        yield
    finally:
        running.client.post(f"/fits/{fit}/cancel").raise_for_status()


@contextmanager
def _nothing() -> Iterator[None]:
    yield


if __name__ == "__main__":
    main()
