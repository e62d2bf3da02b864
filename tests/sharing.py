"""What is made once for all test processes of a run, and fits that are kept for later runs, too."""

import fcntl
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path

import pytest

from models.lifting.fitted_prior import FittedPrior
from models.numerics.source_digests import SourceDigests

ROOT = Path(__file__).parents[1]
KEPT = ROOT / ".pytest_cache" / "fits"
KEPT_VERSIONS = 3  # of the code, so that one may go back and forth between branches
# The code that makes fits, beside the module that names one: it, and all that it imports.
TRAINER = ROOT / "models" / "training" / "trainer.py"
CAPTURES = tuple(ROOT / "tests" / "models" / f"{name}.py" for name in ("rigs", "walk"))
LIBRARIES = ("numba", "numpy", "scipy", "torch")


def made_once(folders: pytest.TempPathFactory, name: str, make: Callable[[], bytes]) -> bytes:
    """Return what `make` makes; of test processes side by side, the first one makes it."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return make()
    return _made_once(folders.getbasetemp().parent / name, make)  # of this run's test processes


def fitted_once(name: str, make: Callable[[], FittedPrior]) -> FittedPrior:
    """Return the prior that `make` fits, as an earlier run or another test process fitted it.

    It is fitted anew when the syntax of any module has changed that takes part: those that fit, the
    captures that tests share, and the module of `make`.
    """
    folder = KEPT / _digest(Path(sys.modules[make.__module__].__file__ or ""))
    return FittedPrior.from_bytes(
        _made_once(folder / f"{name}.safetensors", lambda: make().to_bytes())
    )


def _made_once(file: Path, make: Callable[[], bytes]) -> bytes:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            unfinished = file.with_suffix(".unfinished")
            unfinished.write_bytes(make())
            unfinished.replace(file)
    return file.read_bytes()


@cache
def _digest(module: Path) -> str:
    """Return a digest of the code that makes the fits which a module of tests names."""
    digests = SourceDigests(KEPT / "syntax.json")
    code = [digests.of(file) for file in (TRAINER, *CAPTURES, module)]
    KEPT.mkdir(parents=True, exist_ok=True)
    digests.save()
    versions = [sys.version, *map(version, LIBRARIES)]
    digest = hashlib.sha256(json.dumps([code, versions]).encode()).hexdigest()[:16]
    return f"{module.stem}-{digest}"


def forget_older_fits() -> None:
    """Delete the fits of versions of the code that came before the last few."""
    versions: dict[str, list[Path]] = {}
    for folder in KEPT.glob("*-*/"):
        versions.setdefault(folder.name.rpartition("-")[0], []).append(folder)
    for folders in versions.values():
        folders.sort(key=lambda folder: folder.stat().st_mtime, reverse=True)
        for folder in folders[KEPT_VERSIONS:]:
            shutil.rmtree(folder, ignore_errors=True)
