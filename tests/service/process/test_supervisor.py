"""``fewview serve`` and its parts, killed for real in the middle of what they do."""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import httpx2
import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture
from tests.fork_server import Popen, run
from tests.processes import command_of, descendants, processes, tied
from tests.service.conftest import (
    BYTES,
    Live,
    kill_service,
    start_service,
    to_npz,
)
from tests.tiers import thorough_after
from tests.waiting import wait_for
from worker.process import python

CHAOS_SECONDS = 8.0
FEWEST_KILLED = 6
LONG = {"steps": 1_000_000, "refine": "off"}
SLOW = {"steps": 160, "refine": "off"}
Start = Callable[..., Live]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Give a function that starts the service on one data folder, again after it was killed."""
    started: list[Live] = []

    def start(**how: Any) -> Live:
        options = ("--lease-seconds=4", "--checkpoint-seconds=0.2")
        started.append(start_service(tmp_path / "data", *options, **how))
        return started[-1]

    yield start
    for live in started:
        kill_service(live)


def part(live: Live, *words: str) -> int:
    """Return the process of the service whose command line holds all the words."""
    for pid in descendants(live.process.pid):
        command = command_of(pid).decode()
        parent = processes().get(pid)
        if parent == live.process.pid and all(word in command for word in words):
            return pid
    raise AssertionError(f"there is no process with {words}")


def is_part(live: Live, pid: int) -> bool:
    """Return whether the service started a process, and would start it again."""
    known = (b"service.cli\0worker", b"service.app", b"valkey-server")
    return (
        any(words in command_of(pid) for words in known)
        and processes().get(pid) == live.process.pid
    )


def upload(live: Live, frames: int = 60) -> str:
    seen = synthetic_capture(frames=frames, views=3, noise=1.0, seed=2)
    response = live.http.post("/datasets", content=to_npz(keypoints=seen.keypoints), headers=BYTES)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def wait_for_step(live: Live, fit_id: str, step: int) -> None:
    def reached() -> bool:
        fit = live.get(f"/fits/{fit_id}")
        assert fit["status"] in ("queued", "running"), fit
        return fit["progress"] is not None and fit["progress"]["step"] >= step

    wait_for(reached, f"step {step}")


@pytest.mark.parametrize("victim", thorough_after(1, ["valkey-server", "service.cli"]))
def test_a_part_is_killed_in_the_middle_of_a_fit(start: Start, victim: str) -> None:
    live = start()
    dataset_id = upload(live)
    fit = live.fit(dataset_id, **SLOW)
    waiting = live.fit(dataset_id, steps=5, refine="off")
    wait_for_step(live, fit["id"], 30)
    pid = part(live, victim)
    os.kill(pid, signal.SIGKILL)
    for made in (fit, waiting):
        ended = live.finished(made["id"])
        assert ended["status"] == "succeeded", ended["error"]
        assert ended["model_id"] is not None
    assert part(live, victim) != pid
    ready = wait_for(lambda: live.http.get("/health/ready").status_code == 200, "readiness")
    assert ready


def test_the_api_is_killed_in_the_middle_of_an_upload(start: Start) -> None:
    live = start()
    kept = upload(live)
    body = to_npz(keypoints=np.zeros((2000, 3, 16, 2), np.float32) + 5)
    sent, killed = threading.Event(), threading.Event()

    def slowly() -> Iterator[bytes]:
        yield body[: len(body) // 2]
        sent.set()
        killed.wait(30)
        yield body[len(body) // 2 :]

    outcome: list[Any] = []

    def send() -> None:
        try:
            with httpx2.Client(base_url=live.url, timeout=30) as http:
                outcome.append(http.post("/datasets", content=slowly(), headers=BYTES))
        except httpx2.HTTPError as error:
            outcome.append(error)

    uploading = threading.Thread(target=send)
    uploading.start()
    assert sent.wait(30)
    os.kill(part(live, "service.app"), signal.SIGKILL)
    killed.set()
    uploading.join()
    assert isinstance(outcome[0], httpx2.HTTPError)
    # The listening socket is the supervisor's: this request waits for the new API.
    with httpx2.Client(base_url=live.url, timeout=300) as http:
        items = http.get("/datasets").json()["items"]
        assert [item["id"] for item in items] == [kept]
        assert http.get(f"/datasets/{kept}").json()["frames"] == 60
        files = [p for p in (live.data_dir / "objects" / "datasets").rglob("*") if p.is_file()]
        assert len(files) == 1
        again = http.post("/datasets", content=body, headers=BYTES)
        assert again.status_code == 201


def test_everything_is_killed_and_started_again(start: Start) -> None:
    live = start()
    fit = live.fit(upload(live), **SLOW)
    wait_for_step(live, fit["id"], 30)
    family = descendants(live.process.pid)
    assert len(family) >= 4  # Valkey, worker, work-horse, API
    live.process.kill()
    live.process.wait()
    wait_for(lambda: not family & processes().keys(), "all its processes to die", 5)
    again = start()
    ended = again.finished(fit["id"])
    assert ended["status"] == "succeeded"
    assert ended["attempt"] > 1


def test_sigterm_saves_the_running_fit_for_the_next_start(start: Start) -> None:
    live = start()
    fit = live.fit(upload(live), **SLOW)
    wait_for_step(live, fit["id"], 30)
    family = descendants(live.process.pid)
    live.process.send_signal(signal.SIGINT)
    assert live.process.wait(20) == 0
    assert not family & processes().keys()
    again = start()
    ended = again.finished(fit["id"])
    assert ended["status"] == "succeeded"


@pytest.mark.thorough
def test_nothing_outlives_a_service_whose_parts_are_killed_at_any_time(start: Start) -> None:
    """Most of them as they start others, which are easily forgotten then."""
    live = start()
    live.fit(upload(live), **LONG)
    random, seen, killed = Random(1), set[int](), 0  # noqa: S311
    begins = time.monotonic()
    while (passed := time.monotonic() - begins) < CHAOS_SECONDS or killed < FEWEST_KILLED:
        assert passed < 120, f"{killed} parts were killed"
        begun, seen = descendants(live.process.pid) - seen, seen | descendants(live.process.pid)
        if not begun and random.random() < 0.99:
            time.sleep(0.005)
            continue
        time.sleep(random.uniform(0, 0.05))
        parents = processes()
        parts = {pid for pid in parents if is_part(live, pid)}
        if victims := sorted({parents.get(pid, 0) for pid in begun} & parts or parts):
            with suppress(ProcessLookupError):
                os.kill(random.choice(victims), signal.SIGKILL)
                killed += 1
    seen |= descendants(live.process.pid)
    live.process.terminate()
    live.process.wait(60)
    wait_for(lambda: not seen & processes().keys(), "all that it started to end", 5)


# A part that starts a process and forgets it, as none of ours should.
CARELESS = """
import subprocess, sys
from service.process import supervisor
from service.settings import Settings

program = "import subprocess, sys; print(subprocess.Popen(['sleep', '999']).pid, flush=True)"
wait = "; import os, time\\nwhile not os.path.exists(sys.argv[1]): time.sleep(0.01)"
command = [sys.executable, "-c", program + wait, sys.argv[1] + "/leave"]
supervisor._workers = lambda *_: [supervisor.Child("Careless", command, {})]
supervisor.serve(Settings(port=0, data_dir=sys.argv[1]))
"""


def test_not_even_what_a_part_forgets_outlives_the_service(tmp_path: Path) -> None:
    process = Popen(tied("-c", CARELESS, str(tmp_path), "serve"), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        orphan = int(process.stdout.readline())
        assert "Fewview" in process.stdout.readline()  # it is served
        (tmp_path / "leave").touch()
        wait_for(lambda: orphan not in processes(), "what an ended part forgot to be ended", 30)
        (tmp_path / "leave").unlink()
        forgotten = next(int(line) for line in process.stdout if line.strip().isdigit())
        process.terminate()
        assert process.wait(60) == 0
        assert forgotten not in processes()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_second_service_on_the_same_folder_or_port_is_refused(
    start: Start, tmp_path: Path
) -> None:
    live = start()
    port = live.url.rpartition(":")[2]
    for arguments, reason in (
        (["--port=0", f"--data-dir={live.data_dir}"], "Another `fewview serve` uses"),
        ([f"--port={port}", f"--data-dir={tmp_path / 'other'}"], "Cannot listen on"),
        (["--port=99999"], "--port"),
        (["--frobnicate"], "frobnicate"),
    ):
        refused = run(python("-m", "service.cli", "serve", *arguments))
        assert refused.returncode == 2, refused
        assert reason in refused.stderr


def test_every_setting_is_in_the_help_and_in_the_readme() -> None:
    from service.settings import Settings

    shown = run(python("-m", "service.cli", "serve", "--help")).stdout
    settings = Path("docs/settings.md").read_text()
    for name, field in Settings.model_fields.items():
        assert f"--{name.replace('_', '-')}" in shown
        assert f"FEWVIEW_{name.upper()}" in settings
        assert field.description
