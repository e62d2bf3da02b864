"""What the demo shows on the screen: progress, cameras, figures."""

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

LINE_SECONDS = 3.0  # between two lines of progress where there is no terminal

console = Console(highlight=False)


class ProgressDisplay:
    """A bar on a terminal; a line every few seconds elsewhere."""

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("Fitting"),
            BarColumn(),
            TextColumn("{task.description}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("waiting for a worker", total=None)
        self._next_line, self._printed = 0.0, -1

    def __enter__(self) -> "ProgressDisplay":
        self._bar.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._bar.stop()

    def show(self, fit: dict[str, Any]) -> None:
        """Show how far a fit has come."""
        progress = fit["progress"]
        if progress is None:
            return
        step, steps = progress["step"], progress["steps"]
        loss, error = number(progress["loss"]), number(progress["reprojection_error"])
        left = progress["seconds_left"]
        text = (
            f"{progress['stage']}  step {step}/{steps}  loss {loss}  "
            f"reprojection error {error} px" + (f"  {number(left)} s left" if left else "")
        )
        self._bar.update(self._task, completed=step, total=steps, description=text)
        ended = fit["finished_at"] is not None
        due = step != self._printed and (ended or time.monotonic() >= self._next_line)
        if due and not console.is_terminal:
            console.print(text, soft_wrap=True)
            self._next_line, self._printed = time.monotonic() + LINE_SECONDS, step


def show_cameras(cameras: dict[str, Any]) -> None:
    """Print what the fit found out about its cameras."""
    console.print(f"Cameras: {cameras['arrangement']}. {cameras['reason']}", soft_wrap=True)
    known = [view for view in cameras["views"] if view["focal"] is not None]
    focals = [f"{number(view['focal'][0])} ± {number(view['focal_sd'])}" for view in known]
    if focals:
        console.print(f"Focal lengths (px): {', '.join(focals)}", soft_wrap=True)


def show_findings(findings: list[dict[str, Any]]) -> None:
    """Print what was noticed of the keypoints and the cameras."""
    for finding in findings:
        about = [
            f", {what} {' '.join(map(str, finding[f'{what}s']))}"
            for what in ("view", "keypoint")
            if finding[f"{what}s"]
        ]
        said = f"{finding['code']}{''.join(about)}. {finding['effect']} {finding['remedy']}"
        console.print(f"{finding['severity'].capitalize()}: {said}", soft_wrap=True)


def show(figures: dict[str, Any]) -> None:
    """Print the figures as a table."""
    metres = figures["pck_threshold"] == 0.1
    unit = "the truth's unit" + (", mm if that is the metre" if metres else "")
    threshold = number(figures["pck_threshold"])
    table = Table("", "fitted frames", "unseen frames", title=figures["capture"])
    for column in table.columns[1:]:
        column.justify = "right"
    table.add_row(
        "frames", str(figures["frames"] - figures["frames_unseen"]), str(figures["frames_unseen"])
    )
    if figures["pa_mpjpe"] is not None:
        errors = [distance(figures[f"pa_mpjpe{which}"], metres) for which in ("", "_unseen")]
        table.add_row(f"PA-MPJPE ({unit})", *errors)
        shares = [percent(figures[f"pck{which}"]) for which in ("", "_unseen")]
        table.add_row(f"PCK (closer than {threshold})", *shares)
    errors = [number(figures[f"reprojection_error_px{which}"]) for which in ("", "_unseen")]
    table.add_row("reprojection error (px)", *errors)
    table.add_row("findings", ", ".join(figures["findings"]) or "none", "")
    table.add_row("fit (s)", number(figures["fit_seconds"]), "")
    table.add_row("lift of one frame, median (ms)", "", number(figures["lift_ms_p50"]))
    table.add_row("lift of one frame, 99 in 100 (ms)", "", number(figures["lift_ms_p99"]))
    console.print(table)
    console.print(f"Picture: {figures['picture']}", soft_wrap=True)
    console.print(f"See it move: {figures['page']}", soft_wrap=True)
    ours, theirs = figures["pa_mpjpe"], figures["pa_mpjpe_by_service"]
    if ours is not None and not np.isclose(ours, theirs or np.nan, rtol=1e-3):
        console.print(f"[red]The service itself says PA-MPJPE {theirs}, not {ours}[/red]")


def page_of(fit_id: str, data: Path) -> str:
    """Return how a fit is seen on the page: the command that serves it, and its address there."""
    program = Path(sys.executable).with_name("fewview")
    here = Path.cwd()
    shown = program.relative_to(here) if program.is_relative_to(here) else program
    return f"{shown} serve --data-dir {data}, open the page that it prints, then #/fits/{fit_id}"


def number(value: float | None) -> str:
    """Write a number with three digits that count."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def distance(value: float | None, metres: bool) -> str:
    """Write a distance, in mm too if it may be in metres."""
    return number(value) + (f" ({1000 * value:.1f} mm)" if metres and value is not None else "")


def percent(value: float | None) -> str:
    """Write a share."""
    return "-" if value is None else f"{100 * value:.1f} %"
