"""Regular expressions see what strangers send: each takes time in proportion to its input.

Each is a constant of its module, so that this test finds it, and is run on 100 KB of the letters
that it distinguishes: repeated, alternated, and with an end that does not match.
"""

import ast
import importlib
import json
import pkgutil
import re
import resource
import sys
import time
from collections.abc import Iterator
from itertools import combinations, product
from re import _constants as kinds  # type: ignore[attr-defined]
from re import _parser as parser  # type: ignore[attr-defined]
from typing import Any

import pytest

from tests.fork_server import run
from tests.test_floors import modules
from tests.tiers import thorough_after
from worker.process import python

LENGTH = 100_000  # characters
SECONDS = 90  # of processor time for all: a quadratic one would take hours
# Those that take longer see texts of bounded length: where, and the bound's name.
BOUNDED = {
    "fewview.readers.headers._SPELLINGS": "LONGEST_CELL",
    "fewview.readers.headers._UNIT": "LONGEST_CELL",
    "fewview.readers.unknown_files._NAME_FIRST": "LONGEST_CELL",
    "fewview.readers.unknown_files._WORD_FIRST": "LONGEST_CELL",
}
# Functions that make one of what a caller gives, and why it stays linear.
MADE = {
    "fewview.readers.headers.mapped_columns": "of cells of LONGEST_CELL at most",
    "service.wire.slices._starts": "names of our own fields, at each of which one match begins",
}
MOST_LETTERS = 7  # of a pattern, those that are repeated first
FEW, SLOWEST = 4000, 4  # characters of all cases, and how many cases see all
PACKAGES = ("service", "worker", "store", "fewview")


def test_regular_expressions_are_constants_of_their_modules() -> None:
    found = set()
    for name, path in modules().items():
        if name.partition(".")[0] not in PACKAGES:
            continue
        for outer in ast.parse(path.read_text()).body:
            inside = isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            for call in ast.walk(outer):
                if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
                    continue
                of_re = isinstance(call.func.value, ast.Name) and call.func.value.id == "re"
                if of_re and call.func.attr != "escape" and (inside or call.func.attr != "compile"):
                    found.add(f"{name}.{getattr(outer, 'name', call.lineno)}")
            assert not isinstance(outer, ast.ImportFrom) or outer.module != "re", name
    assert found == set(MADE)


def test_every_pattern_takes_linear_time() -> None:
    code = f"import sys; sys.path[:] = {sys.path!r}; from tests.test_patterns import main; main()"
    done = run(python("-c", code))
    last = done.stdout.splitlines()[-1:]
    assert done.returncode == 0, f"after {SECONDS} s of processor time at {last}: {done.stderr}"
    assert len(done.stdout.splitlines()) > 40


@pytest.mark.parametrize(
    "slow", thorough_after(2, [r"(?:/[^ ]+)*(?=x)", r"\s+$", r"(\d+)(?=\D*$)", r"(a|aa)+$"])
)
def test_slow_ones_are_noticed(slow: str) -> None:
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from tests.test_patterns import *;"
        f"bounded(1); strain(re.compile({slow!r}), LENGTH)"
    )
    assert run(python("-c", code)).returncode != 0


def main() -> None:
    """Print the name of each pattern, and strain it."""
    bounded(SECONDS)
    seen: set[tuple[Any, int]] = set()
    for name, pattern, length in patterns():
        if (key := (pattern, pattern.flags)) not in seen:
            seen.add(key)
            print(json.dumps([name, str(pattern.pattern)]), flush=True)
            strain(pattern, length)


def bounded(seconds: int) -> None:
    """Bound the processor time of this process."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    most = int(spent.ru_utime + spent.ru_stime) + seconds
    resource.setrlimit(resource.RLIMIT_CPU, (most, most))


def patterns() -> Iterator[tuple[str, re.Pattern[Any], int]]:
    """Yield the patterns among the constants of all modules, and the length that each sees."""
    for package in PACKAGES:
        folder = importlib.import_module(package).__path__
        for found in pkgutil.walk_packages(folder, f"{package}."):
            if found.name.endswith("__main__") or ".migrations." in found.name:
                continue
            module = importlib.import_module(found.name)
            for name, value in vars(module).items():
                place = f"{found.name}.{name}"
                bound = BOUNDED.get(place)
                length = getattr(module, bound) if bound else LENGTH
                for pattern in _inside(value):
                    yield place, pattern, length


def _inside(value: Any) -> Iterator[re.Pattern[Any]]:
    if isinstance(value, re.Pattern):
        yield value
    elif isinstance(value, tuple | list | set | frozenset):
        for item in value:
            yield from _inside(item)
    elif isinstance(value, dict):
        yield from _inside([*value.keys(), *value.values()])


def strain(pattern: re.Pattern[Any], length: int) -> None:
    """Run a pattern on the worst of its own letters: on a part of all, then on the slowest."""
    taken = {case: seconds_of(pattern, *case, min(length, FEW)) for case in cases(pattern)}
    for case in sorted(taken, key=lambda case: -taken[case])[:SLOWEST]:
        seconds_of(pattern, *case, length)


def seconds_of(pattern: re.Pattern[Any], unit: str, end: str, length: int) -> float:
    """Run a pattern on a unit that is repeated and an end; return the processor time it takes."""
    text = (unit * (length // len(unit)))[: length - len(end)] + end
    given = text if isinstance(pattern.pattern, str) else text.encode("latin-1", "replace")
    began = time.process_time()
    pattern.sub(given[:0], given)  # it searches from wherever it may begin
    pattern.fullmatch(given)
    return time.process_time() - began


def cases(pattern: re.Pattern[Any]) -> Iterator[tuple[str, str]]:
    """Yield letters of a pattern, alone and in pairs, to be repeated; each with several ends."""
    letters = list(dict.fromkeys(_letters(parser.parse(pattern.pattern, pattern.flags))))
    letters = letters[:MOST_LETTERS] or ["x"]
    units = [*letters, *map("".join, combinations(letters, 2)), "".join(letters)]
    yield from product(units, ["", "\0", letters[-1] + letters[0]])


def _letters(tokens: Any) -> Iterator[str]:
    """Yield a letter of each literal and class of a parsed pattern, the repeated ones first."""
    later: list[Any] = []
    for kind, value in tokens:
        if kind in (kinds.MAX_REPEAT, kinds.MIN_REPEAT, kinds.POSSESSIVE_REPEAT):
            yield from _letters(value[2])
        else:
            later.append((kind, value))
    for kind, value in later:
        if kind is kinds.LITERAL:
            yield chr(value)
        elif kind is kinds.NOT_LITERAL:
            yield "x" if value != ord("x") else "y"
        elif kind is kinds.ANY:
            yield "x"
        elif kind is kinds.IN:
            yield from _of_class(value)
        elif isinstance(value, tuple | list):
            for part in _parts(value):
                yield from _letters(part)
        elif isinstance(value, parser.SubPattern):
            yield from _letters(value)


def _parts(value: Any) -> Iterator[Any]:
    """Yield the parsed patterns within what belongs to a token."""
    for part in value:
        if isinstance(part, parser.SubPattern):
            yield part
        elif isinstance(part, tuple | list):
            yield from _parts(part)


def _of_class(items: Any) -> Iterator[str]:
    """Yield letters of a class, such as ``[a-z_]``: of one that excludes, others."""
    inside = re.compile(
        "|".join(_class_item(item) for item in items if item[0] is not kinds.NEGATE)
    )
    negated = items[0][0] is kinds.NEGATE
    some = [letter for letter in "a1_ -./:+AZx\t(\"'é" if bool(inside.match(letter)) != negated]
    yield from some[:2]
    yield from (chr(item[1]) for item in items[:2] if item[0] is kinds.LITERAL and not negated)


def _class_item(item: Any) -> str:
    kind, value = item
    if kind is kinds.LITERAL:
        return re.escape(chr(value))
    if kind is kinds.RANGE:
        return f"[{re.escape(chr(value[0]))}-{re.escape(chr(value[1]))}]"
    named = {
        kinds.CATEGORY_DIGIT: r"\d",
        kinds.CATEGORY_NOT_DIGIT: r"\D",
        kinds.CATEGORY_SPACE: r"\s",
        kinds.CATEGORY_NOT_SPACE: r"\S",
        kinds.CATEGORY_WORD: r"\w",
        kinds.CATEGORY_NOT_WORD: r"\W",
    }
    return named[value]
