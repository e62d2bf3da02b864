"""What benchmarks of speed have in common: figures beside their bars, as tables and as JSON."""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

PACKAGES = ("fewview-server", "numpy", "torch")
DPI = 150
FEWEST_TURNS = 4

Row = dict[str, Any]
Key = TypeVar("Key", bound=Hashable)
console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


@dataclass(frozen=True)
class Bar:
    """What must hold, and what was reached."""

    what: str
    limit: float
    reached: float | None  # None: never
    unit: str
    least: bool = False  # whether `limit` is the least that will do, rather than the most

    @property
    def held(self) -> bool:
        """Whether the bar was reached."""
        if self.reached is None:
            return False
        return self.reached >= self.limit if self.least else self.reached <= self.limit

    def row(self) -> Row:
        """Return the bar as a row of a table."""
        sign = "at least" if self.least else "at most"
        return {
            "bar": self.what,
            "asked": f"{sign} {show(self.limit)} {self.unit}".rstrip(),
            "reached": f"{show(self.reached)} {self.unit}" if self.reached is not None else "never",
            "held": "yes" if self.held else "no",
        }


@dataclass(frozen=True)
class Results:
    """Everything that one run of one benchmark measured."""

    benchmark: str
    options: Row
    tables: dict[str, list[Row]]  # by title; the rows of a table have the same columns
    bars: Sequence[Bar] = ()

    def publish(self, file: Path | None) -> None:
        """Print the tables and the bars; write everything to `file`."""
        for title, rows in self.tables.items():
            print_table(title, rows)
        if self.bars:
            print_table("Bars", [bar.row() for bar in self.bars])
        if file is not None:
            file.write_text(json.dumps(self.as_json(), indent=1) + "\n")

    def as_json(self) -> Row:
        """Return the results as `benchmarks/tables.py` reads them."""
        return {
            "benchmark": self.benchmark,
            "machine": machine(),
            "options": {name: _plain(value) for name, value in self.options.items()},
            "tables": self.tables,
            "bars": [asdict(bar) | {"held": bar.held} for bar in self.bars],
        }


def command(about: str) -> argparse.ArgumentParser:
    """Return a parser of the options that every benchmark has."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--json", type=Path, help="also write all figures to this file")
    return parser


def take_turns(ways: dict[Key, Callable[[], object]], seconds: float) -> dict[Key, list[float]]:
    """Call the ways in turns until the time is up; return the seconds that each call took."""
    times: dict[Key, list[float]] = {key: [] for key in ways}
    ends = time.perf_counter() + seconds
    turn = 0
    while turn < FEWEST_TURNS or time.perf_counter() < ends:
        for key, way in ways.items():
            started = time.perf_counter()
            way()
            times[key].append(time.perf_counter() - started)
        turn += 1
    return {key: those[1:] for key, those in times.items()}  # the first one warms up


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """Return median and 99th percentile in milliseconds."""
    p50, p99 = np.percentile(seconds, (50, 99)) if len(seconds) else (np.nan, np.nan)
    return {"p50 ms": 1000 * float(p50), "p99 ms": 1000 * float(p99)}


def show(value: object) -> str:
    """Return a cell's text: three digits that matter, or all before the point."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Print rows that have the same columns."""
    if not rows:
        return
    table = Table(title=title, title_justify="left")
    for name in rows[0]:
        numbers = all(isinstance(row[name], int | float | None) for row in rows)
        table.add_column(name, justify="right" if numbers else "left")
    for row in rows:
        table.add_row(*map(show, row.values()))
    console.print(table)


def machine() -> dict[str, Any]:
    """Return what the figures depend on."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    names = {name.strip(): value.strip() for name, value in fields.items()}
    return {
        "processor": names.get("model name", platform.machine()),
        "instructions": [
            name for name in ("avx2", "avx512f") if name in names.get("flags", "").split()
        ],
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }


def draw_lines(
    panels: dict[str, dict[str, list[tuple[float, float]]]],
    path: Path,
    *,
    title: str,
    labels: dict[str, tuple[str, str]],
    linear: Sequence[str] = (),
) -> None:
    """Draw a panel of lines each, the points of a line by its name.

    `labels` has those of the x and y axis for each panel. Panels named in `linear` get, beside
    each line, what it would be if it grew in proportion to x from its first point.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (name, lines) in zip(axes, panels.items(), strict=False):
        for label, points in lines.items():
            x, y = np.array(sorted(points), float).T
            (line,) = ax.plot(x, y, marker="o", markersize=4, label=label)
            if name in linear:
                ax.plot(x, y[0] * x / x[0], ":", color=line.get_color(), alpha=0.5)
        ax.set(title=name, xlabel=labels[name][0], ylabel=labels[name][1])
        ax.set(xscale="log", yscale="log")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter(lambda value, _: show(value))
            axis.set_minor_formatter("")
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=7)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    figure.savefig(path, dpi=DPI)
    console.print(f"drawn: {path.name}")


def _plain(value: object) -> object:
    return value.name if isinstance(value, Path) else value
