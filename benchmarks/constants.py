"""Which constants of `models` move the errors of fits: each is halved and doubled.

    python -m benchmarks.constants --data DIRECTORY --json ROWS.json
    python -m benchmarks.constants --show ROWS.json

A capture is drawn (`DRAWS`), fitted and lifted as it is, then with constants changed that its code
reads. Several constants of a module change together; if errors move by more than `WORTH`, each half
of them is asked again, until those are known that move errors alone. They are not asked again by
the next capture, and the others are. So a constant that moves nothing was changed in every capture
that reads it, though beside others: two that make up for each other are missed.

What runs before the first answer of a fit is judged by that answer, what runs later by whole fits.
Errors are those of `benchmarks/ablation.py`. Constants of compiled functions, and those that are
bound once (defaults of arguments, of classes), cannot be changed while a program runs and are not
asked. Each question is a child process: what a wrong size breaks, or makes endless, counts as a
failure. A run that was interrupted goes on where its file ends.
"""

import argparse
import json
import math
import resource
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from benchmarks.ablation import (
    FEW_STEPS,
    SLACK,
    WORTH,
    Job,
    Taken,
    errors_of,
    fitted,
    taken_of,
)
from benchmarks.draws import FAILURES
from benchmarks.figures import print_table
from benchmarks.found_constants import DOUBLE, HALF, Constant, constants, read_constants, set_to
from models.numerics.threads import use_threads
from models.settings.config import FitConfig

# One of each kind, then all others, fast ones first: what moves one is not asked again.
DRAWS = (
    *(("setting", number) for number in (2, 6)),
    ("setting moving", 0),
    *(("looking", number) for number in (3, 2)),
    ("looking moving", 0),
    *(("setting", number) for number in (11, 7, 13, 1, 8, 9)),
    *(("setting moving", 1), ("looking moving", 1)),
    *(("setting", number) for number in (4, 5, 10, 12)),
    *(("looking", number) for number in (0, 1)),
)
WHOLE = (("setting", 2), ("looking", 3))
TOGETHER = 8  # constants of a module that change at a time, at first
FAILS = 10.0  # stands for the log ratio where a fit fails
PATIENCE_SECONDS = 60  # of processor time, ten times what most draws take

Errors = tuple[float, float, float]
Question = tuple[str, int, bool, float, tuple[str, ...]]  # the first fields of a row


class Row(NamedTuple):
    """What constants that change together by a factor did to the errors of a capture."""

    source: str
    number: int
    whole: bool  # a whole fit, or its first answer
    factor: float
    names: tuple[str, ...]
    moved: float  # the largest log ratio of errors
    alone: bool  # whether these are known to move errors, or not to


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Halve and double constants.")
    parser.add_argument("--data", type=Path, help="folder of captures, with motions/")
    parser.add_argument("--draws", type=int, default=len(DRAWS), help="so many of them")
    parser.add_argument("--factors", type=float, nargs="+", default=(HALF, DOUBLE))
    parser.add_argument("--json", type=Path, help="add answers to this file; go on where it ends")
    parser.add_argument("--show", type=Path, nargs="+", help="show results that were written")
    arguments = parser.parse_args()
    use_threads(1)
    if arguments.show:
        rows = [row for path in arguments.show for row in _rows(path)]
    else:
        rows = [row for factor in arguments.factors for row in _ask(arguments, factor)]
    print_table("Constants by folder", list(by_folder(rows)))
    print("Read, and move nothing:", *moving_nothing(rows), sep="\n  ")


def _rows(path: Path | None) -> list[Row]:
    """Return the rows of a file, if there is one."""
    if path is None or not path.exists():
        return []
    rows = (Row(*json.loads(line)) for line in path.read_text().splitlines())
    return [row._replace(names=tuple(row.names)) for row in rows]


def _ask(arguments: argparse.Namespace, factor: float) -> list[Row]:
    """Change constants by a factor, in one capture after another."""
    among = [one for one in constants() if not one.fixed and one.changed(factor) is not None]
    known = {row[:5]: row for row in _rows(arguments.json) if row.factor == factor}
    rows: list[Row] = []
    kinds = [(*draw, False) for draw in DRAWS[: arguments.draws]]
    kinds += [(*draw, True) for draw in WHOLE if draw in DRAWS[: arguments.draws]]
    for kind in kinds:
        source, number, _ = kind
        taken = taken_of(Job(source, str(number), arguments.data, (), ()))
        if taken is None:
            continue
        moved = {row.names[0] for row in rows if row.alone and row.moved > WORTH}
        left = [one for one in among if _name(one) not in moved]
        for row in _in_capture(kind, taken, left, factor, known):
            rows.append(row)
            if arguments.json and row[:5] not in known:
                with arguments.json.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    return rows


def _in_capture(
    kind: tuple[str, int, bool],
    taken: Taken,
    among: Sequence[Constant],
    factor: float,
    known: Mapping[Question, Row],
) -> Iterator[Row]:
    whole = kind[2]
    with read_constants(among) as read:
        before = _errors(taken, whole=False)
    if whole:
        with read_constants(among) as read_by_whole:
            before = _errors(taken, whole=True)
        read = read_by_whole - read
    groups: dict[str, list[Constant]] = defaultdict(list)
    for one in among:
        if (one.module, one.name) in read:
            groups[one.module].append(one)

    def asked(group: Sequence[Constant]) -> Iterator[Row]:
        here = (*kind, factor, tuple(map(_name, group)))
        if here in known:
            moved = known[here].moved
        else:
            with set_to([(one, one.changed(factor)) for one in group]):
                moved = _in_child(lambda: _moved(before, _errors(taken, whole=whole)))
        if moved <= WORTH or len(group) == 1:
            yield Row(*here, moved, True)
        else:
            yield Row(*here, moved, False)
            middle = len(group) // 2
            yield from asked(group[:middle])
            yield from asked(group[middle:])

    for group in groups.values():
        for start in range(0, len(group), TOGETHER):
            yield from asked(group[start : start + TOGETHER])


def _in_child(measure: Callable[[], float]) -> float:
    """Return what a function measures in a fork, or `FAILS` if it fails or takes too long."""
    context = get_context("fork")
    ours, theirs = context.Pipe(duplex=False)

    def send() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE_SECONDS, PATIENCE_SECONDS))
        with suppress(*FAILURES):
            theirs.send(measure())

    child = context.Process(target=send, daemon=True)
    child.start()
    theirs.close()
    try:
        return float(ours.recv())
    except EOFError:
        return FAILS
    finally:
        child.join()


def _name(constant: Constant) -> str:
    return f"{constant.module.removeprefix('models.')}.{constant.name}"


def _errors(taken: Taken, *, whole: bool) -> Errors:
    prior, _ = fitted(taken, FitConfig() if whole else FitConfig(steps=FEW_STEPS))
    errors, _ = errors_of(prior, taken, alone=whole)
    return errors


def _moved(before: Errors, after: Errors) -> float:
    """Return the largest log ratio; a figure that is gone counts as a failure."""
    largest = 0.0
    for one, other in zip(before, after, strict=True):
        if math.isfinite(one) != math.isfinite(other):
            return FAILS
        if math.isfinite(one):
            largest = max(largest, abs(math.log((other + SLACK) / (one + SLACK))))
    return largest


def _outcomes(rows: Sequence[Row]) -> tuple[set[str], set[str]]:
    """Return the names of constants that were asked, and of those that move errors."""
    read = {name for row in rows for name in row.names}
    return read, {row.names[0] for row in rows if row.alone and row.moved > WORTH}


def by_folder(rows: Sequence[Row]) -> Iterator[dict[str, str | int]]:
    """Yield a row for each folder of `models`, and one for all."""
    read, moving = _outcomes(rows)
    every = constants()
    for folder in (*sorted({one.module.split(".")[1] for one in every}), ""):
        own = [one for one in every if not folder or one.module.split(".")[1] == folder]
        names = [_name(one) for one in own if not one.fixed]
        yield {
            "folder": folder or "all",
            "constants": len(own),
            "not asked": sum(bool(one.fixed) for one in own),
            "not read": sum(name not in read for name in names),
            "move errors": sum(name in moving for name in names),
            "move nothing": sum(name in read and name not in moving for name in names),
        }


def moving_nothing(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the constants that were changed and moved nothing, with the captures that read them."""
    read, moving = _outcomes(rows)
    captures: dict[str, set[tuple[str, int]]] = defaultdict(set)
    for row in rows:
        for name in row.names:
            captures[name].add((row.source, row.number))
    for name in sorted(read - moving):
        yield f"{name} ({len(captures[name])})"


if __name__ == "__main__":
    main()
