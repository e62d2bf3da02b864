"""A folder imports only from the floors below it; who forks never sees torch nor numba."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = ("models", "store", "worker", "service")  # from the bottom


def imported_packages(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("floor", FLOORS)
def test_imports_go_down_only(floor: str) -> None:
    above = set(FLOORS[FLOORS.index(floor) + 1 :])
    files = sorted((ROOT / floor).rglob("*.py"))
    assert files
    for path in files:
        assert not imported_packages(path) & above, f"{path} imports a floor above its own"


@pytest.mark.parametrize(
    ("floor", "foreign"),
    [
        ("models", {"fastapi", "starlette", "redis", "rq", "sqlalchemy", "obstore"}),
        ("store", {"fastapi", "starlette", "redis", "rq", "torch", "numba"}),
        ("worker", {"fastapi", "starlette", "uvicorn"}),
    ],
)
def test_a_floor_knows_nothing_of_what_others_do(floor: str, foreign: set[str]) -> None:
    for path in (ROOT / floor).rglob("*.py"):
        assert not imported_packages(path) & foreign, path


@pytest.mark.parametrize("module", ["worker.runner", "service.process.supervisor", "service.cli"])
def test_processes_that_fork_load_neither_torch_nor_numba(module: str) -> None:
    code = f"import sys, {module}; sys.exit(bool({{'torch', 'numba'}} & sys.modules.keys()))"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
