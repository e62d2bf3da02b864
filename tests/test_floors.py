"""The order of the house: what may import what, and how large a thing may grow.

A folder imports only from the floors below it, a package only from those below it.
"""

import ast
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = ("models", "store", "worker", "service")  # from the bottom
PRINTING = ("worker.logs", "service.access", "service.keeping")  # names of others
CLIENT = "fewview"  # stands apart, in `client/`
# Packages and modules of a floor from the bottom; those of one line do not import each other.
PACKAGES = {
    "models": (
        ("settings",),
        ("findings",),
        ("numerics",),
        ("capture",),
        ("optics",),
        ("epipolar",),
        ("network",),
        ("bundle",),
        ("calibrating",),
        ("causes",),
        ("posterior",),
        ("lifting",),
        ("labelling",),
        ("training",),
    ),
    "service": (
        ("settings",),
        ("http",),
        ("wire",),
        ("report",),
        ("page",),
        ("realtime",),
        ("resources",),
        ("app",),
        ("doctor", "health_check", "openapi", "process"),
        ("keeping",),
        ("access",),
        ("cli",),
    ),
    CLIENT: (
        ("geometry",),
        (
            "capture",
            "errors",
            "evaluation",
            "moments",
            "plain",
            "sockets",
        ),
        (
            "calibration",
            "corrections",
            "embedded",
            "keys",
            "lenses",
            "measures",
            "mended",
            "reading_options",
        ),
        ("animation",),
        ("gif", "readers"),
        ("api", "known_data"),
        ("client", "room"),
        ("height", "products", "writers"),
        ("live",),
        ("commands",),
        ("cli",),
    ),
}
FILE_LINES, FUNCTION_LINES = 400, 60
COMPILED = {"compiled", "inner", "reordered"}  # a call costs time in inner loops: those may be long
# What a part of the house does not load, not even through what it imports.
LIGHT = (
    "models.settings",
    "models.findings",
    "worker.runner",
    "service.process.supervisor",
    "service.cli",
)


@cache
def modules() -> dict[str, Path]:
    """Return the file of every module in the house; a folder is the module of its `__init__`."""
    found = {}
    for folder in (*(ROOT / floor for floor in FLOORS), ROOT / "client" / CLIENT):
        for file in folder.rglob("*.py"):
            name = ".".join(file.relative_to(folder.parent).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = file
    return found


@cache
def imports(module: str) -> frozenset[str]:
    """Return the names of all modules that a module imports, wherever in its text."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(modules()[module].read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            base = node.module or ""
            whole = {f"{base}.{alias.name}" for alias in node.names}
            names.update(name if name in modules() else base for name in whole)
    return frozenset(names)


def parts(module: str) -> tuple[str, str]:
    """Return the floor and the package of a module, the latter empty for a floor's `__init__`."""
    floor, _, rest = module.partition(".")
    return floor, rest.partition(".")[0]


@pytest.mark.parametrize("floor", FLOORS)
def test_a_floor_imports_only_from_floors_below(floor: str) -> None:
    above = set(FLOORS[FLOORS.index(floor) + 1 :])
    mine = [module for module in modules() if parts(module)[0] == floor]
    assert len(mine) > 3
    for module in mine:
        assert not {parts(name)[0] for name in imports(module)} & above, module


@pytest.mark.parametrize("floor", PACKAGES)
def test_a_package_imports_only_from_packages_below(floor: str) -> None:
    level = {
        package: number for number, packages in enumerate(PACKAGES[floor]) for package in packages
    }
    mine = [module for module in modules() if parts(module)[0] == floor and parts(module)[1]]
    assert {parts(module)[1] for module in mine} == level.keys(), (
        "the order must name every package"
    )
    for module in mine:
        package = parts(module)[1]
        for name in imports(module):
            imported = parts(name)[1]
            if parts(name)[0] == floor and imported and imported != package:
                assert level[imported] < level[package], f"{module} imports {name}"


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {module: imports(module) & modules().keys() for module in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle of imports: {error.args[1]}")


@pytest.mark.parametrize(
    ("floor", "foreign"),
    [
        ("models", {"fastapi", "starlette", "redis", "rq", "sqlalchemy", "obstore"}),
        ("store", {"fastapi", "starlette", "redis", "rq", "torch", "numba"}),
        ("worker", {"fastapi", "starlette", "uvicorn"}),
    ],
)
def test_a_floor_knows_nothing_of_what_others_do(floor: str, foreign: set[str]) -> None:
    for module in modules():
        if parts(module)[0] == floor:
            assert not {parts(name)[0] for name in imports(module)} & foreign, module


@pytest.mark.parametrize("part", LIGHT)
def test_forking_code_and_settings_load_neither_torch_nor_numba(part: str) -> None:
    inside = [module for module in modules() if f"{module}.".startswith(f"{part}.")]
    assert inside
    code = f"import sys, {', '.join(inside)}; print({{'torch', 'numba'}} & sys.modules.keys())"
    ran = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True, text=True
    )
    assert ran.stdout == "set()\n"


def test_the_client_knows_no_floor_and_is_known_for_its_cameras_and_rooms_alone() -> None:
    """They are two distributions: the client talks HTTP, and needs none of what a floor needs."""
    for file in python_files("client/fewview"):
        for node in ast.walk(ast.parse(file.read_text())):
            named = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {parts(name)[0] for name in named} & {*FLOORS, "torch", "numba"}, file
    for module in modules():
        if parts(module)[0] == CLIENT:
            continue
        used = {parts(name) for name in imports(module) if parts(name)[0] == CLIENT}
        known = {"calibration", "capture", "errors", "evaluation", "moments", "readers"}
        printed = {"plain"} if module in PRINTING else set()
        allowed = known | {"reading_options"} if module.startswith("service.wire.") else set()
        if module == "service.wire.animations":
            allowed = {"animation", "errors", "writers"}
        if module == "service.wire.labels":
            allowed = {"writers"}
        if module == "worker.rooms":
            allowed = {"geometry"}
        if module == "service.http.peers":
            allowed = {"sockets"}
        assert {name for _, name in used} <= allowed | printed, module


@pytest.mark.parametrize("floor", FLOORS)
def test_every_package_has_a_docstring(floor: str) -> None:
    for folder in {file.parent for file in (ROOT / floor).rglob("*.py")}:
        text = (folder / "__init__.py").read_text()
        assert ast.get_docstring(ast.parse(text)), f"{folder} needs a docstring in __init__.py"


def python_files(*folders: str) -> list[Path]:
    return sorted(file for folder in folders for file in (ROOT / folder).rglob("*.py"))


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return a function's lines, its signature and its docstring left out."""
    first = function.body[1 if ast.get_docstring(function) else 0 :] or function.body
    return (function.end_lineno or 0) - first[0].lineno + 1


@pytest.mark.parametrize("folder", [*FLOORS, "client", "examples", "benchmarks", "tests"])
def test_no_file_is_too_long(folder: str) -> None:
    lengths = {file: len(file.read_text().splitlines()) for file in python_files(folder)}
    assert lengths
    assert not {str(file): n for file, n in lengths.items() if n > FILE_LINES}


@pytest.mark.parametrize("folder", [*FLOORS, "client", "examples", "benchmarks"])
def test_no_function_is_too_long(folder: str) -> None:
    long = []
    for file in python_files(folder):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
                if length(node) > FUNCTION_LINES and not decorators & COMPILED:
                    long.append(f"{file}: {node.name} has {length(node)} lines")
    assert not long
