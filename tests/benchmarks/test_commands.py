"""A benchmark's command, run as people run it, and its figures on their way into the docs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture
from tests import fork_server
from worker.process import python

ROOT = Path(__file__).parents[2]


def run(*words: str) -> str:
    done = fork_server.run(python(*words), cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    file, capture = folder / "lift.json", folder / "figure.npz"
    seen = synthetic_capture(frames=20, views=2)
    np.savez(capture, keypoints=seen.keypoints, image_sizes=np.array(seen.image_sizes))
    tiny = (
        "--capture",
        str(capture),
        "--steps",
        "1",
        "--batches",
        "1",
        "--refine",
        "off",
        "--seconds",
        "0",
    )
    printed = run("benchmarks/lift.py", *tiny, "--json", str(file))
    assert "in process, feed-forward, one frame, p50" in printed
    return file


def test_lifts_every_way(figures: Path) -> None:
    found = json.loads(figures.read_text())

    rows = found["tables"]["Lifts"]
    assert {row["way"] for row in rows} >= {"in process", "HTTP, JSON", "HTTP, binary"}
    assert all(row["p50 ms"] > 0 for row in rows)
    assert found["bars"][0]["reached"] == rows[0]["p50 ms"]


def test_writes_figures_into_the_docs(figures: Path, tmp_path: Path) -> None:
    document = tmp_path / "performance.md"
    shutil.copy(ROOT / "docs" / "performance.md", document)

    run("benchmarks/tables.py", str(figures), "--document", str(document))
    once = document.read_text()
    run("benchmarks/tables.py", str(figures), "--document", str(document))

    assert document.read_text() == once
    assert "| feed-forward | 1 | in process |" in once
    assert "| lift | in process, feed-forward, one frame, p50 |" in once
