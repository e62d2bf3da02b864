"""A Fewview of the benchmark's own, and what it is asked to do before anything is timed."""

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
from safetensors.numpy import save

from benchmarks.captures import Capture, Float32
from models.lifting.fitted_prior import FittedPrior

sys.path.append(str(Path(__file__).parents[1] / "examples"))  # where `embedded` lies
from fewview.embedded import running_service

BYTES = "application/octet-stream"
POLL_SECONDS = 0.02
UPLOAD_FRAMES = 50_000  # in one request


@dataclass(frozen=True)
class Service:
    """A running service."""

    address: str
    client: httpx2.Client  # convenient and slow: not for what is timed

    @property
    def host(self) -> str:
        """The name that it listens on."""
        return httpx2.URL(self.address).host

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return httpx2.URL(self.address).port or 80

    def import_model(self, prior: FittedPrior) -> str:
        """Store a model and return its identifier."""
        answer = self.client.post(
            "/models", content=prior.to_bytes(), headers={"Content-Type": BYTES}
        )
        return str(answer.raise_for_status().json()["id"])

    def upload(self, capture: Capture) -> str:
        """Store a capture without its truth and return the dataset's identifier."""
        body = capture.npz("keypoints", "confidence", "image_sizes")
        answer = self.client.post("/datasets", content=body, headers={"Content-Type": BYTES})
        return str(answer.raise_for_status().json()["id"])

    def upload_many(self, keypoints: Float32, frames: int) -> str:
        """Store so many frames, those of `keypoints` (N, K, P, 2) again and again."""
        path = "/datasets"
        for start in range(0, frames, UPLOAD_FRAMES):
            which = np.arange(start, min(start + UPLOAD_FRAMES, frames)) % len(keypoints)
            body = save({"keypoints": keypoints[which]})
            answer = self.client.post(path, content=body, headers={"Content-Type": BYTES})
            dataset = answer.raise_for_status().json()["id"]
            path = f"/datasets/{dataset}/frames"
        return str(dataset)

    def run(self, path: str, body: dict[str, Any]) -> tuple[dict[str, Any], float]:
        """Make a job, wait for its end, return its record and the seconds from first to last."""
        started = time.perf_counter()
        made = self.client.post(path, json=body).raise_for_status().json()
        while True:
            found = self.client.get(f"{path}/{made['id']}").raise_for_status().json()
            if found["status"] not in ("queued", "running"):
                break
            time.sleep(POLL_SECONDS)
        seconds = time.perf_counter() - started
        if found["status"] != "succeeded":
            sys.exit(f"{path}/{made['id']} {found['status']}: {json.dumps(found['error'])}")
        return found, seconds


def copy_model(model: str, source: Service, target: Service) -> str:
    """Store a model of one service in another and return its identifier there."""
    weights = source.client.get(f"/models/{model}/weights").raise_for_status().content
    answer = target.client.post("/models", content=weights, headers={"Content-Type": BYTES})
    return str(answer.raise_for_status().json()["id"])


@contextmanager
def service(*options: str, data: Path | None = None) -> Iterator[Service]:
    """Run a service with everything embedded; `options` are those of ``fewview serve``.

    It stores in the folder `data` if that is given, else in a temporary one.
    """
    with (
        running_service(*options, data=data) as address,
        httpx2.Client(base_url=address, timeout=600, trust_env=False) as client,
    ):
        yield Service(address, client)


def api_processes() -> list[int]:
    """Return the processes that answer requests of the services that run below this process.

    Raises
    ------
    RuntimeError
        If there is none, or no /proc to look for them.
    """
    found = [process for process, _, command in processes_below() if b"service.app" in command]
    if not found:
        raise RuntimeError("found no process of the API below this one in /proc")
    return found


def processes_below() -> Iterator[tuple[int, int, list[bytes]]]:
    """Yield every process below this one: itself, its parent, the words of its command."""
    waiting = [(os.getpid(), os.getppid())]
    while waiting:
        process, parent = waiting.pop()
        try:
            command = Path(f"/proc/{process}/cmdline").read_bytes().split(b"\0")
            threads = list(Path(f"/proc/{process}/task").iterdir())
            children = " ".join((thread / "children").read_text() for thread in threads)
        except OSError:  # it has just ended
            continue
        yield process, parent, command
        waiting += [(int(child), process) for child in children.split()]


def resident_bytes(process: int) -> int:
    """Return how much memory a process has in use."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def proportional_bytes(process: int) -> int:
    """Return the same with what several processes share divided among them."""
    rows = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return next(1024 * int(row.split()[1]) for row in rows if row.startswith("Pss:"))
