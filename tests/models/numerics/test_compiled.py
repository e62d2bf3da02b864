"""Machine code is kept between processes, and never outlives a change that the compiler sees."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from models.numerics.compiled import KEPT_VERSIONS

ROOT = Path(__file__).parents[3]
# Root may write everywhere unless this right is taken from it.
COMMON_USER = () if os.geteuid() else ("setpriv", "--bounding-set", "-dac_override")
# A compiled function of one room that calls a compiled function of another.
CALLED = "from models.numerics.compiled import inner\n@inner\ndef two() -> float:\n    return 2.0\n"
CALLER = """
from models.numerics.called import two
from models.numerics.compiled import compiled
@compiled
def twice(x: float) -> float:
    return two() * x
"""
ASK = """
from models.lifting.caller import twice
print(twice(21.0), sum(twice.stats.cache_hits.values()))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a copy of `models/` and of the two functions."""
    shutil.copytree(ROOT / "models", tmp_path / "models", ignore=lambda *_: {"__pycache__"})
    (tmp_path / "models/numerics/called.py").write_text(CALLED)
    (tmp_path / "models/lifting/caller.py").write_text(CALLER)
    return tmp_path


@contextmanager
def write_protected(folder: Path) -> Iterator[None]:
    paths = [folder, *folder.rglob("*")]
    for path in paths:
        path.chmod(path.stat().st_mode & ~0o222)
    try:
        yield
    finally:
        for path in paths:
            path.chmod(path.stat().st_mode | 0o200)


def ask(folder: Path, **environment: str) -> tuple[float, int]:
    """Return the answer of a new process, and how many functions it did not have to compile."""
    inherited = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    user = {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder / "user")}
    # Python would take a file of the same second and size for the one whose bytecode it kept.
    user["PYTHONDONTWRITEBYTECODE"] = "1"
    done = subprocess.run(
        [*COMMON_USER, sys.executable, "-c", ASK],
        cwd=folder,
        env={**inherited, **user, **environment},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    answer, hits = done.stdout.split()
    return float(answer), int(hits)


def test_machine_code_is_kept_until_a_function_of_another_room_changes(folder: Path) -> None:
    assert ask(folder) == (42.0, 0)
    assert ask(folder) == (42.0, 1)
    (folder / "models/numerics/called.py").write_text(CALLED.replace("2.0", "3.0"))
    assert ask(folder) == (63.0, 0)
    (folder / "models/numerics/called.py").write_text(CALLED)  # back on the branch of before
    assert ask(folder) == (42.0, 1)


@pytest.mark.thorough
def test_what_the_compiler_does_not_see_compiles_nothing(folder: Path) -> None:
    assert ask(folder) == (42.0, 0)
    called, caller = (
        folder / f"models/{name}.py" for name in ("numerics/called", "lifting/caller")
    )
    called.write_text('"""Two."""\n' + CALLED.replace(":\n", ':\n    """Return two."""\n'))
    caller.write_text("# Twice as much.\n\n" + CALLER)
    (folder / "models/lifting/curve.py").write_text("two = 3\n")  # which the functions do not reach
    assert ask(folder) == (42.0, 1)


def test_of_two_processes_one_compiles_and_the_other_waits(folder: Path) -> None:
    with ThreadPoolExecutor() as pool:
        answers = [pool.submit(ask, folder) for _ in range(2)]
        assert sorted(answer.result() for answer in answers) == [(42.0, 0), (42.0, 1)]


@pytest.mark.thorough
def test_machine_code_of_the_last_versions_alone_is_kept(folder: Path) -> None:
    for number in range(KEPT_VERSIONS + 2):
        (folder / "models/numerics/called.py").write_text(CALLED.replace("2.0", f"{number}.0"))
        assert ask(folder) == (21.0 * number, 0)
    for suffix in ("nbi", "nbc"):
        kept = (folder / "models/__pycache__/compiled").glob(f"caller.twice-*.{suffix}")
        assert len(list(kept)) == KEPT_VERSIONS
    assert ask(folder) == (21.0 * number, 1)


def test_the_folder_may_be_chosen(folder: Path) -> None:
    chosen = str(folder / "chosen")
    assert ask(folder, NUMBA_CACHE_DIR=chosen) == (42.0, 0)
    assert ask(folder, NUMBA_CACHE_DIR=chosen) == (42.0, 1)
    assert not list((folder / "models/__pycache__").glob("compiled/*.nbi"))


def test_machine_code_is_read_where_it_cannot_be_written(folder: Path) -> None:
    assert ask(folder) == (42.0, 0)
    with write_protected(folder):
        assert ask(folder) == (42.0, 1)


@pytest.mark.thorough
def test_where_no_folder_can_be_written_every_process_compiles(folder: Path) -> None:
    with write_protected(folder):
        assert ask(folder) == (42.0, 0)
        assert ask(folder) == (42.0, 0)
