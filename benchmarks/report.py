"""Rows of figures: printed as they come, their medians as tables, JSON and plots."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

HEAD = f"{'case':<10}{'how':<50}{'views':<14}{'level':>6}{'seed':>6}{'mm':>8}{'PCK':>7}"
HEAD += f"{'frames':>8}{'fit s':>8}{'focal':>8}"
TRNG = "TRNG"
DPI = 150
OUTLIER = 0.5  # probability from which a keypoint counts as found


class Found(NamedTuple):
    """How well planted outliers are found."""

    precision: float  # share of what is found that was planted
    recall: float  # share of what was planted that is found


def precision_and_recall(
    probability: NDArray[np.floating[Any]], planted: NDArray[np.bool_]
) -> Found:
    """Return how well `outlier_probability` (N, K, P) marks the planted outliers."""
    found = probability > OUTLIER
    both = int((found & planted).sum())
    return Found(both / max(1, int(found.sum())), both / max(1, int(planted.sum())))


@dataclass(frozen=True)
class Row:
    """One figure of one seed."""

    case: str
    how: str
    views: tuple[int, ...]
    level: float | None  # pixels, share or sigma, as the case has it
    seed: int
    error_mm: float  # PA-MPJPE, mean over frames
    pck: float  # share of the keypoints within the threshold
    frames: int  # that were scored
    fit_seconds: float | None  # of the fit behind it, which rows share; None without one
    focal: float | None  # pixels, mean of what the fit found
    found: Found | None = None  # where outliers were planted

    def line(self) -> str:
        """Return the row as text, in the columns of `HEAD`."""
        level = "" if self.level is None else f"{self.level:g}"
        seconds = "" if self.fit_seconds is None else f"{self.fit_seconds:.1f}"
        focal = "" if self.focal is None else f"{self.focal:.0f}"
        return (
            f"{self.case:<10}{self.how:<50}{names(self.views):<14}{level:>6}{self.seed:>6}"
            f"{self.error_mm:>8.2f}{100 * self.pck:>7.1f}{self.frames:>8}{seconds:>8}{focal:>8}"
            f"{_described(self.found)}"
        )


@dataclass(frozen=True)
class Curve:
    """PCK against the threshold, of one seed."""

    label: str
    seed: int
    thresholds_mm: list[float]
    pck: list[float]


@dataclass
class Report:
    """Everything measured so far."""

    say: Callable[[str], None]
    rows: list[Row] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """Keep a row and print it."""
        if not self.rows:
            self.say(HEAD)
        self.rows.append(row)
        self.say(row.line())

    def medians(self) -> list[dict[str, Any]]:
        """Return the medians over the seeds of rows that differ in nothing else."""
        groups: dict[tuple[Any, ...], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row.case, row.how, row.views, row.level), []).append(row)
        answer = []
        for (case, how, views, level), rows in groups.items():
            errors = [row.error_mm for row in rows]
            seconds = [row.fit_seconds for row in rows if row.fit_seconds is not None]
            focals = [row.focal for row in rows if row.focal is not None]
            found = [row.found for row in rows if row.found is not None]
            answer.append(
                {
                    "case": case,
                    "how": how,
                    "views": views,
                    "level": level,
                    "seeds": [row.seed for row in rows],
                    "error_mm": round(median(errors), 2),
                    "least_mm": round(min(errors), 2),
                    "most_mm": round(max(errors), 2),
                    "pck": round(median(row.pck for row in rows), 4),
                    "frames": rows[0].frames,
                    "fit_seconds": round(median(seconds), 1) if seconds else None,
                    "focal": round(median(focals), 1) if focals else None,
                    "found": [round(median(s), 4) for s in zip(*found, strict=True)] or None,
                }
            )
        return answer

    def as_json(self) -> dict[str, Any]:
        """Return rows, medians and curves."""
        rows = [asdict(row) for row in self.rows]
        for row in rows:
            for name in ("error_mm", "pck", "fit_seconds", "focal"):
                row[name] = None if row[name] is None else round(row[name], 4)
        curves = [asdict(curve) for curve in self.curves]
        return {"medians": self.medians(), "rows": rows, "curves": curves}


def _described(found: Found | None) -> str:
    return "" if found is None else "  found: precision {:.3f}, recall {:.3f}".format(*found)


def names(views: Iterable[int]) -> str:
    """Return views as a user would write them."""
    return ",".join(map(str, views))


def markdown(medians: list[dict[str, Any]]) -> str:
    """Return the medians as a table per case."""
    parts = []
    for case in dict.fromkeys(row["case"] for row in medians):
        lines = [
            f"### {case}",
            "",
            "| how | views | level | PA-MPJPE, mm | least to most | PCK, % | frames | fit, s"
            " | focal, px |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for row in medians:
            if row["case"] != case:
                continue
            level = "" if row["level"] is None else f"{row['level']:g}"
            span = f"{row['least_mm']:.2f} to {row['most_mm']:.2f}" if len(row["seeds"]) > 1 else ""
            seconds = "" if row["fit_seconds"] is None else f"{row['fit_seconds']:.0f}"
            focal = "" if row["focal"] is None else f"{row['focal']:.0f}"
            how = row["how"] + (_described(Found(*row["found"])) if row["found"] else "")
            lines.append(
                f"| {how} | {names(row['views'])} | {level} | {row['error_mm']:.2f}"
                f" | {span} | {100 * row['pck']:.1f} | {row['frames']} | {seconds} | {focal} |"
            )
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def draw(report: Report, title: str, folder: Path) -> list[Path]:
    """Draw what there is: error against views, error against noise, PCK against the threshold."""
    medians = report.medians()
    pictures = (
        ("views.png", _draw_lines(medians, "views", "views", "views that a frame is lifted from")),
        ("noise.png", _draw_lines(medians, "noise", "level", "2D noise, px")),
        ("trng.png", _draw_lines(medians, "trng", "level", "sigma of the miscalibration")),
        ("pck.png", _draw_curves(report.curves)),
    )
    paths = []
    for name, figure in pictures:
        if figure is not None:
            figure.suptitle(title)
            figure.savefig(folder / name, dpi=DPI)
            paths.append(folder / name)
    return paths


def _draw_lines(medians: list[dict[str, Any]], case: str, along: str, label: str) -> Figure | None:
    rows = [row for row in medians if row["case"] == case]
    if not rows:
        return None
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if along == "views":
            lines.setdefault(row["how"], []).append((len(row["views"]), row["error_mm"]))
        else:
            key = f"{row['how']}, views {names(row['views'])}"
            lines.setdefault(key, []).append((row["level"] or 0, row["error_mm"]))
    for name, points in lines.items():
        places = sorted({x for x, _ in points})
        middle = [median(y for x, y in points if x == place) for place in places]
        style = "--" if name.startswith(TRNG) else "-"
        (line,) = axes.plot(places, middle, style, marker="o", markersize=4, label=name)
        if len(points) > len(places):  # every subset, and the line through their medians
            axes.plot(*zip(*points, strict=True), ".", alpha=0.4, color=line.get_color())
    if along == "views":
        axes.set_xticks(sorted({len(row["views"]) for row in rows}))
    axes.set(xlabel=label, ylabel="PA-MPJPE, mm", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return figure


def _draw_curves(curves: list[Curve]) -> Figure | None:
    if not curves:
        return None
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for label in dict.fromkeys(curve.label for curve in curves):
        mine = [curve for curve in curves if curve.label == label]
        middle = [100 * median(values) for values in zip(*(c.pck for c in mine), strict=True)]
        style = "--" if label.startswith(TRNG) else "-"
        axes.plot(mine[0].thresholds_mm, middle, style, label=label)
    axes.set(xlabel="threshold, mm", ylabel="correct keypoints, %", ylim=(0, 101))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return figure
