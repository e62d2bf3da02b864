"""How long a fit takes to a given error, from `POST /fits` to the stored model; cold and warm.

    python benchmarks/fit.py [CAPTURE.npz] [--unit m] [--image-size WxH] [--only cold warm]
                             [--feed-forward 2 4 8 12] [--refined 10 20 45] [--targets 20.7 3]
                             [--plot FILE.png] [--json FILE]

The truth is used here alone, after the fits. README.md says what each row is.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.numpy import load

from benchmarks.captures import Capture, from_options
from benchmarks.figures import Bar, Results, Row, command, console, draw_lines
from benchmarks.service_rig import BYTES, Service, service
from models.capture.metrics import pa_mpjpe

ROOT = Path(__file__).parents[1]
MILLIMETRES = {"m": 1000.0, "cm": 10.0, "mm": 1.0}
BAR_SECONDS = (12.0, 45.0)  # for the two targets, feed-forward and refined
KINDS = ("feed-forward", "refined")


@dataclass(frozen=True)
class Run:
    """One fit."""

    start: str  # "cold", or "from a model"
    kind: str  # of KINDS
    budget: float  # seconds that the fit was given
    seconds: float  # from POST /fits to the end
    steps: int
    error_mm: float  # PA-MPJPE of its reconstruction, mean over frames, never mirrored
    model: str

    def row(self) -> Row:
        """Return the figures as columns."""
        return {
            "start": self.start,
            "fit": self.kind,
            "budget s": self.budget,
            "seconds": self.seconds,
            "steps": self.steps,
            "error mm": self.error_mm,
        }


@dataclass(frozen=True)
class Bench:
    """A service with a warm worker, and what its fits are measured by."""

    running: Service
    millimetres: float  # per unit of the truth
    seed: int

    def fit(
        self, capture: Capture, dataset: str, kind: str, budget: float, source: str | None = None
    ) -> Run:
        """Fit a stored capture within a budget, from the model `source` if there is one."""
        config: dict[str, Any] = {"budget_s": budget, "seed": self.seed}
        if kind == KINDS[0]:
            config["refine"] = "off"
        body = {"dataset_id": dataset, "config": config}
        if source is not None:
            body["from_model"] = source
        made, seconds = self.running.run("/fits", body)
        answer = self.running.client.get(
            f"/fits/{made['id']}/reconstruction", headers={"Accept": BYTES}
        )
        points = load(answer.raise_for_status().content)["points3d"]
        assert capture.points3d is not None
        error = self.millimetres * pa_mpjpe(points, capture.points3d, reflection="never").mean
        steps = int((made["progress"] or {}).get("step", 0))
        start = "cold" if source is None else "from a model"
        run = Run(start, kind, budget, seconds, steps, error, str(made["model_id"]))
        console.print(f"{start}, {kind}: {budget:g} s asked, {seconds:.1f} s taken, {error:.2f} mm")
        return run


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    capture = from_options(arguments)
    if capture.points3d is None:
        sys.exit("The capture has no points3d: nothing to measure against")
    budgets = {KINDS[0]: arguments.feed_forward, KINDS[1]: arguments.refined}
    tables: dict[str, list[Row]] = {}
    bars: list[Bar] = []
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with service() as running:
        bench = Bench(running, MILLIMETRES[arguments.unit], arguments.seed)
        warm_up(bench, capture)
        for case in arguments.only:
            runs = (cold if case == "cold" else warm)(bench, capture, budgets)
            title = {"cold": "Whole capture", "warm": "Second half, after the first"}[case]
            tables[title] = [run.row() for run in runs]
            panels[title] = curves(runs)
            if case == "cold":
                bars = judge(runs, arguments.targets)
    if arguments.plot is not None:
        labels = dict.fromkeys(panels, ("seconds from POST /fits", "PA-MPJPE, mm"))
        draw_lines(panels, arguments.plot, title="Error against time", labels=labels)
    Results("fit", vars(arguments), tables, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure seconds to a given error.")
    example = ROOT / "examples" / "three_actors.npz"
    parser.add_argument("capture", type=Path, nargs="?", default=example, help=".npz with points3d")
    parser.add_argument("--image-size", help="WxH of every view, if the file does not say")
    parser.add_argument("--unit", choices=list(MILLIMETRES), default="m", help="of points3d")
    parser.add_argument("--only", nargs="+", choices=("cold", "warm"), default=["cold", "warm"])
    parser.add_argument(
        "--feed-forward", type=float, nargs="*", default=[1, 2, 4, 8, 12], help="budgets, seconds"
    )
    parser.add_argument("--refined", type=float, nargs="*", default=[10, 15, 20, 30, 45])
    parser.add_argument(
        "--targets", type=float, nargs=2, default=(20.7, 3.0), help="mm, feed-forward and refined"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, help="draw error against seconds to this PNG")
    return parser.parse_args()


def warm_up(bench: Bench, capture: Capture) -> None:
    """Let the worker do a short fit, so that what it loads and compiles is ready."""
    few = capture.frames(slice(0, 64))
    body = {"dataset_id": bench.running.upload(few), "config": {"steps": 20}}
    bench.running.run("/fits", body)


def cold(bench: Bench, capture: Capture, budgets: dict[str, list[float]]) -> list[Run]:
    """Fit the whole capture with every budget."""
    dataset = bench.running.upload(capture)
    return [
        bench.fit(capture, dataset, kind, budget)
        for kind, list_of in budgets.items()
        for budget in list_of
    ]


def warm(bench: Bench, capture: Capture, budgets: dict[str, list[float]]) -> list[Run]:
    """Fit the second half of the capture cold, and from a model of the first half; in turns."""
    middle = len(capture) // 2
    first, second = capture.frames(slice(0, middle)), capture.frames(slice(middle, None))
    before, dataset = bench.running.upload(first), bench.running.upload(second)
    runs = []
    for kind, list_of in budgets.items():
        if not list_of:
            continue
        source = bench.fit(first, before, kind, max(list_of)).model
        for budget in list_of:
            runs.append(bench.fit(second, dataset, kind, budget))
            runs.append(bench.fit(second, dataset, kind, budget, source))
    return runs


def curves(runs: list[Run]) -> dict[str, list[tuple[float, float]]]:
    """Return error against seconds of each start and kind."""
    answer: dict[str, list[tuple[float, float]]] = {}
    for run in runs:
        answer.setdefault(f"{run.kind}, {run.start}", []).append((run.seconds, run.error_mm))
    return answer


def judge(runs: list[Run], targets: tuple[float, float]) -> list[Bar]:
    """Return the least seconds that led to each target."""
    bars = []
    for kind, target, most in zip(KINDS, targets, BAR_SECONDS, strict=True):
        mine = [run for run in runs if run.kind == kind]
        if mine:
            good = [run.seconds for run in mine if run.error_mm <= target]
            reached = min(good, default=None)
            bars.append(Bar(f"{kind} fit to {target:g} mm", most, reached, "s"))
    return bars


if __name__ == "__main__":
    main()
