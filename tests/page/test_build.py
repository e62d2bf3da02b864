"""Building the page: not again without need, and in one line where it cannot be done."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Copy what building needs."""
    shutil.copytree(ROOT / "page", tmp_path / "page", ignore=shutil.ignore_patterns("node_modules"))
    (tmp_path / "service" / "page").mkdir(parents=True)
    return tmp_path


def build(clone: Path) -> "subprocess.CompletedProcess[str]":
    """Build where there is no node, neither a wheel's nor the machine's."""
    return subprocess.run(
        [sys.executable, "-I", "-S", str(clone / "page" / "build.py")],
        env={"PATH": os.devnull},
        capture_output=True,
        text=True,
        check=False,
    )


def test_without_node_one_line_says_so(clone: Path) -> None:
    done = build(clone)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("The page was not built; all else works without it (there is no node")


def test_a_page_that_was_built_is_left_until_its_sources_change(clone: Path) -> None:
    built = clone / "service" / "page" / "built"
    built.mkdir()
    (built / "index.html").write_text("built")
    assert build(clone).returncode == 0  # as from an sdist, whose reader has no node
    newer = (built / "index.html").stat().st_mtime + 1
    os.utime(clone / "page" / "src" / "app.tsx", (newer, newer))
    assert build(clone).returncode == 1
    assert (built / "index.html").read_text() == "built"
