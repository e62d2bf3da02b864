"""Digests of the compiler's input: the syntax of a module, and of the modules it imports.

Docstrings, comments, blank lines and line numbers change no machine code, so they change no digest.
"""

import ast
import hashlib
import json
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]  # of the package `models`
PACKAGE = "models"
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)

Seen = tuple[str, tuple[str, ...]]  # digest of a file's syntax, modules of the package it imports


class SourceDigests:
    """Digests of modules of this package, kept in a file from one process to the next.

    Parsing all modules takes a second, reading the file a hundredth.
    """

    def __init__(self, memory: Path | None) -> None:
        """Keep digests in the file `memory`, if any; `save` writes it."""
        self._memory = memory
        self._seen: dict[str, Seen] = {}  # by the digest of a file's bytes
        self._new: set[str] = set()
        if memory is not None:
            with suppress(OSError, ValueError, TypeError):
                read = json.loads(memory.read_bytes())
                self._seen = {key: (str(d), tuple(map(str, i))) for key, (d, i) in read.items()}

    def of(self, file: Path) -> str:
        """Return a digest of the syntax of a Python file and of all it imports of this package.

        Imports count wherever they are in the file, directly or through other modules; a package
        counts as its ``__init__``. Raises ``OSError`` if the file cannot be read, ``SyntaxError``
        if it is not Python.
        """
        found: dict[str, str] = {}
        waiting = [file]
        while waiting:
            path = waiting.pop()
            name = os.path.relpath(path, ROOT)
            if name not in found:
                found[name], imported = self._syntax(path)
                waiting += filter(None, map(file_of, imported))
        return hashlib.sha256(json.dumps(sorted(found.items())).encode()).hexdigest()

    def save(self) -> None:
        """Write new digests to the file; other processes may read or write it at the same time."""
        if self._memory is None or not self._new:
            return
        new = self._memory.with_suffix(f".{os.getpid()}")
        with suppress(OSError):
            new.write_text(json.dumps(self._seen))
            new.replace(self._memory)
        self._new.clear()

    def _syntax(self, path: Path) -> Seen:
        source = path.read_bytes()
        key = hashlib.sha256(source).hexdigest()
        if key not in self._seen:
            tree = ast.parse(source)
            imported = tuple(sorted(_imports(tree)))
            self._seen[key] = (_digest(tree), imported)
            self._new.add(key)
        return self._seen[key]


@cache
def file_of(module: str) -> Path | None:
    """Return the file of a module of this package; None if there is no such module."""
    path = ROOT.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.exists():
            return file
    return None


def _imports(tree: ast.AST) -> set[str]:
    """Return every name in an import that may be a module of this package."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name for name in names if f"{name}.".startswith(f"{PACKAGE}.")}


def _digest(tree: ast.Module) -> str:
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()
