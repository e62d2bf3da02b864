"""The demo, run as its users run it: the file's path, then what it prints."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.capture.synthetic import SyntheticCapture, synthetic_capture
from tests import fork_server
from tests.service.conftest import kill_service, start_service
from worker.process import python

DEMO = Path(__file__).parents[2] / "examples" / "demo.py"


def run_demo(folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run the demo where `folder` is the current directory and holds all temporary files."""
    environment = os.environ | {"TMPDIR": str(folder)}
    return fork_server.run(python(str(DEMO), *arguments), cwd=folder, env=environment)


def processes_of(folder: Path) -> list[str]:
    """Return the processes that the demo started there, known by environment or arguments."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_text()
            environment = (process / "environ").read_bytes().split(b"\0")
            if f"TMPDIR={folder}".encode() in environment or f"{folder}/" in command:
                found.append(command)
        except OSError:  # it has just ended, or is not ours to look at
            continue
    return found


def arrays_of(capture: SyntheticCapture) -> dict[str, Any]:
    return {
        "keypoints": capture.keypoints,
        "confidence": capture.confidence,
        "points3d": capture.points3d,
        "keypoint_names": np.array(capture.keypoint_names),
        "edges": np.array(capture.edges),
        "image_sizes": np.array(capture.image_sizes),
    }


def test_shows_figures_and_a_picture_and_leaves_nothing_behind(tmp_path: Path) -> None:
    capture = synthetic_capture(
        frames=40, views=3, noise=1.0, hidden_views=0.1, hidden_keypoints=0.1
    )
    np.savez(tmp_path / "figure.npz", **arrays_of(capture))

    done = run_demo(tmp_path, "figure.npz", "--steps", "60")

    assert done.returncode == 0, done.stderr
    assert processes_of(tmp_path) == []
    assert not list(tmp_path.glob("fewview*"))
    assert "\x1b" not in done.stdout
    assert "\r" not in done.stdout
    assert "step 60/60" in done.stdout
    assert "Cameras: " in done.stdout

    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["capture"] == "figure.npz"
    assert f"See it move: {figures['page']}" in done.stdout
    assert (figures["frames"], figures["views"], figures["keypoints"]) == (40, 3, 16)
    assert figures["frames_unseen"] == 4
    assert figures["missing_fraction"] == pytest.approx(np.isnan(capture.keypoints).mean())
    assert 0 < figures["pa_mpjpe"] < 0.5
    assert figures["pa_mpjpe"] == pytest.approx(figures["pa_mpjpe_by_service"], rel=1e-4)
    assert 0 < figures["pa_mpjpe_unseen"] < 0.5
    assert 0 <= figures["pck"] <= 1
    assert 0 < figures["reprojection_error_px"] < 200
    assert 0 < figures["reprojection_error_px_unseen"] < 200
    assert 0 < figures["lift_ms_p50"] <= figures["lift_ms_p99"]
    assert figures["fit_seconds"] > 0
    assert figures["cameras"] in ("static", "moving", "mixed", "unknown")
    assert all(focal > 0 for focal in figures["focal_px"])
    picture = Path(figures["picture"])
    assert picture == tmp_path / "demo-output" / "figure.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 10_000


def test_needs_neither_truth_nor_edges(tmp_path: Path) -> None:
    capture = synthetic_capture(frames=3, views=2)
    np.savez(tmp_path / "bare.npz", keypoints=capture.keypoints)

    done = run_demo(tmp_path, "bare.npz", "--steps", "5")

    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["frames_unseen"] == 1
    assert figures["pa_mpjpe"] is None
    assert figures["pa_mpjpe_unseen"] is None
    assert figures["pck"] is None
    assert Path(figures["picture"]).exists()
    command, _, address = figures["page"].partition(", open the page that it prints, then ")
    live = start_service(tmp_path / command.partition("--data-dir ")[2])
    try:
        assert live.get(f"/fits/{address.rpartition('/')[2]}")["status"] == "succeeded"
    finally:
        kill_service(live)


def test_says_what_was_expected_of_a_bad_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "bad.npz", poses=np.zeros((9, 2, 8, 2)))

    done = run_demo(tmp_path, "bad.npz")

    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("demo.py: bad.npz: the file holds poses; expected an .npz file")
    assert len(done.stderr.splitlines()) == 1


def test_passes_on_what_the_service_refuses(tmp_path: Path) -> None:
    np.savez(tmp_path / "far.npz", keypoints=np.full((9, 2, 8, 2), 1e9))

    done = run_demo(tmp_path, "far.npz")

    assert done.returncode == 2
    assert done.stderr.startswith("demo.py: far.npz: /keypoints: ")
    assert len(done.stderr.splitlines()) == 1
    assert processes_of(tmp_path) == []
