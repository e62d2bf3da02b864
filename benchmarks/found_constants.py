"""The constants of `models`: numbers that a module names, and the code that reads them."""

import ast
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
HALF, DOUBLE = 0.5, 2.0
COMPILERS = ("compiled", "inner", "reordered")  # decorators


class Constant(NamedTuple):
    """A number, or a tuple of numbers, that a module of `models` names in capitals."""

    module: str
    name: str
    readers: tuple[tuple[str, str], ...]  # modules that read it, and its name in each
    fixed: str  # "" if it can be changed while the program runs, else why it cannot

    def changed(self, factor: float) -> Any:
        """Return its value times a factor; of a share above a half, what is missing to 1.

        None where that is the value itself.
        """
        value = getattr(import_module(self.module), self.name)
        times = _times(value, factor)
        return None if times == value else times


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(part, factor) for part in value)
    if isinstance(value, int):
        return max(round(value * factor), min(value, 1))
    if 0.5 < value < 1:
        return 1 - (1 - value) * factor
    return value * factor


@contextmanager
def set_to(values: Sequence[tuple[Constant, Any]]) -> Iterator[None]:
    """Change constants in every module that reads them, and forget what was computed of them."""
    before = []
    try:
        for constant, value in values:
            for module, name in constant.readers:
                owner = import_module(module)
                before.append((owner, name, getattr(owner, name)))
                setattr(owner, name, value)
        _forget()
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)
        _forget()


def _forget() -> None:
    for name, module in list(sys.modules.items()):
        if name.startswith("models."):
            for known in vars(module).values():
                if callable(getattr(known, "cache_clear", None)):
                    known.cache_clear()


def constants() -> list[Constant]:
    """Return all constants of `models`, by module."""
    paths = sorted((ROOT / "models").rglob("*.py"))
    trees = {_module(path): ast.parse(path.read_text()) for path in paths}
    found = {(module, name): [(module, name)] for module in trees for name in _named(module, trees)}
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                for alias in node.names:
                    if (node.module, alias.name) in found:
                        found[node.module, alias.name].append((module, alias.asname or alias.name))
    return [
        Constant(*place, tuple(readers), _why_not(trees, readers))
        for place, readers in found.items()
    ]


def _module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _named(module: str, trees: dict[str, ast.Module]) -> Iterator[str]:
    """Yield the names in capitals that a module gives to plain numbers."""
    known = vars(import_module(module))
    for node in trees[module].body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        for target in targets:
            parts = target.elts if isinstance(target, ast.Tuple) else [target]
            for part in parts:
                if isinstance(part, ast.Name) and part.id.isupper() and _plain(known[part.id]):
                    yield part.id


def _plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_plain(part) for part in value)
    return type(value) in (int, float)


def _why_not(trees: dict[str, ast.Module], readers: Sequence[tuple[str, str]]) -> str:
    """Return why a constant cannot be changed while the program runs, or nothing."""
    for module, name in readers:
        for why, node in _fixed(trees[module]):
            if any(isinstance(part, ast.Name) and part.id == name for part in ast.walk(node)):
                return why
    return ""


def _fixed(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Yield what is computed once: compiled functions, defaults, fields of classes."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            if any(ast.unparse(one) in COMPILERS for one in node.decorator_list):
                yield "compiled", node
            for default in (*node.args.defaults, *node.args.kw_defaults):
                if default is not None:
                    yield "bound", default
        if isinstance(node, ast.ClassDef):
            yield from (("bound", part) for part in node.body if isinstance(part, ast.AnnAssign))


@contextmanager
def read_constants(among: Sequence[Constant]) -> Iterator[set[tuple[str, str]]]:
    """Collect the constants that code names which runs."""
    places = {place: (one.module, one.name) for one in among for place in one.readers}
    ran: set[CodeType] = set()
    found: set[tuple[str, str]] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or code in ran:
            return
        ran.add(code)
        module = frame.f_globals.get("__name__", "")
        for name in code.co_names:
            if (module, name) in places:
                found.add(places[module, name])

    sys.setprofile(note)
    try:
        yield found
    finally:
        sys.setprofile(None)
