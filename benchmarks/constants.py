"""Which constants of `models` move the errors of fits: each is halved and doubled.

    python -m benchmarks.constants --data DIRECTORY --json ROWS.json
    python -m benchmarks.constants --show ROWS.json

A capture is drawn (`DRAWS`), fitted and lifted as it is, then with constants changed that its code
reads. Several constants of a module change together; if errors move by more than `WORTH`, each half
of them is asked again, until those are known that move errors alone. They are not asked again by
the next capture, and the others are. So a constant that moves nothing was changed in every capture
that reads it, though beside others: two that make up for each other are missed.

What runs before the first answer of a fit is judged by that answer, the rest by whole fits. Errors
are those of `benchmarks/ablation.py`. Constants of compiled functions, and those that are bound
once (defaults of arguments, of classes), cannot be changed while a program runs and are not asked.
"""

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import partial
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
from benchmarks.draws import FAILURES, in_pool
from benchmarks.figures import print_table
from benchmarks.found_constants import DOUBLE, HALF, Constant, constants, read_constants, set_to
from models.settings.config import FitConfig

# Fast ones first: a constant that moves them is not asked again.
DRAWS = (
    *(("setting", number) for number in (2, 11, 7, 13, 1, 8)),
    *(("looking", number) for number in (2, 3)),
    *(("setting", number) for number in (6, 9)),
    *(("setting moving", number) for number in (0, 1)),
    *(("looking moving", number) for number in (0, 1)),
    *(("setting", number) for number in (4, 5, 10, 12)),
    *(("looking", number) for number in (0, 1)),
)
WHOLE = (("setting", 2), ("looking", 3), ("looking moving", 0))
TOGETHER = 8  # constants of a module that change at a time, at first
FAILS = 10.0  # stands for the gain where a fit fails

Errors = tuple[float, float, float]


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
    parser.add_argument("--processes", type=int, default=2, help="one for each factor")
    parser.add_argument("--json", type=Path, help="write what was asked; one file a factor")
    parser.add_argument("--show", type=Path, nargs="+", help="show results that were written")
    arguments = parser.parse_args()
    if arguments.show:
        rows = [_row(line) for path in arguments.show for line in path.read_text().splitlines()]
    else:
        asking = partial(_ask, arguments)
        found = in_pool(asking, (HALF, DOUBLE), arguments.processes)
        rows = [row for part in found for row in part]
    print_table("Constants by folder", list(by_folder(rows)))
    print("Read, and move nothing:", *moving_nothing(rows), sep="\n  ")


def _row(line: str) -> Row:
    source, number, whole, factor, names, moved, alone = json.loads(line)
    return Row(source, number, whole, factor, tuple(names), moved, alone)


def _ask(arguments: argparse.Namespace, factor: float) -> list[Row]:
    """Change constants by a factor, in one capture after another."""
    among = [one for one in constants() if not one.asked and one.changed(factor) is not None]
    rows: list[Row] = []
    kinds = [(*draw, False) for draw in DRAWS[: arguments.draws]]
    kinds += [(*draw, True) for draw in WHOLE if draw in DRAWS[: arguments.draws]]
    for source, number, whole in kinds:
        taken = taken_of(Job(source, str(number), arguments.data, (), ()))
        if taken is None:
            continue
        moved = {row.names[0] for row in rows if row.alone and row.moved > WORTH}
        left = [one for one in among if _name(one) not in moved]
        for row in _in_capture(source, number, taken, left, factor, whole=whole):
            rows.append(row)
            if arguments.json:
                with arguments.json.with_suffix(f".{factor}.jsonl").open("a") as file:
                    file.write(json.dumps(row) + "\n")
    return rows


def _in_capture(
    source: str,
    number: int,
    taken: Taken,
    among: Sequence[Constant],
    factor: float,
    *,
    whole: bool,
) -> Iterator[Row]:
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
    here = partial(Row, source, number, whole, factor)

    def asked(group: Sequence[Constant]) -> Iterator[Row]:
        with set_to([(one, one.changed(factor)) for one in group]):
            try:
                moved = _moved(before, _errors(taken, whole=whole))
            except FAILURES:
                moved = FAILS
        names = tuple(map(_name, group))
        if moved <= WORTH or len(group) == 1:
            yield here(names, moved, True)
        else:
            yield here(names, moved, False)
            middle = len(group) // 2
            yield from asked(group[:middle])
            yield from asked(group[middle:])

    for group in groups.values():
        for start in range(0, len(group), TOGETHER):
            yield from asked(group[start : start + TOGETHER])


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
        names = [_name(one) for one in own if not one.asked]
        yield {
            "folder": folder or "all",
            "constants": len(own),
            "not asked": sum(bool(one.asked) for one in own),
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
