"""What a frame costs against views, keypoints, dictionary size, warm models, frames and workers.

    python benchmarks/scaling.py [--only views keypoints dictionary models frames workers]
                                 [--largest 100000] [--plot FILE.png] [--json FILE]

The sizes of a case take turns. README.md says what each case is.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks.figures import Bar, Results, Row, command, draw_lines
from benchmarks.scaling_process import (
    Costs,
    measure_dictionary,
    measure_keypoints,
    measure_views,
)
from benchmarks.scaling_service import measure_frames, measure_models, measure_workers
from models.numerics.threads import use_threads


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)  # as in the service
    tables: dict[str, list[Row]] = {}
    bars: list[Bar] = []
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    labels: dict[str, tuple[str, str]] = {}
    for name in arguments.only:
        costs, found = CASES[name](arguments)
        unit = UNITS.get(name, "µs per frame")
        tables[f"Against {name}: {unit}"] = rows(name, costs)
        panels[name] = {what: sorted(by_size.items()) for what, by_size in costs.items()}
        labels[name] = (name, unit)
        bars += found
    if arguments.plot is not None:
        title = "Cost of a frame (dotted: in proportion)"
        draw_lines(
            panels,
            arguments.plot,
            title=title,
            labels=labels,
            linear=("views", "keypoints", "dictionary"),
        )
    Results("scaling", vars(arguments), tables, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how costs grow.")
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seconds", type=float, default=10, help="for each case in this process")
    parser.add_argument("--largest", type=int, default=100_000, help="frames of a lift by a job")
    parser.add_argument(
        "--job-frames", type=int, default=100_000, help="of the lift that workers share"
    )
    parser.add_argument("--models", type=int, default=64, help="most warm models: %(default)s")
    parser.add_argument("--plot", type=Path, help="draw all cases to this PNG")
    return parser.parse_args()


def rows(name: str, costs: Costs) -> list[Row]:
    """Return a row for each size."""
    sizes = sorted({size for by_size in costs.values() for size in by_size})
    return [
        {name: size, **{what: by_size.get(size) for what, by_size in costs.items()}}
        for size in sizes
    ]


CASES: dict[str, Callable[[argparse.Namespace], tuple[Costs, list[Bar]]]] = {
    "views": measure_views,
    "keypoints": measure_keypoints,
    "dictionary": measure_dictionary,
    "models": measure_models,
    "frames": measure_frames,
    "workers": measure_workers,
}
UNITS = {"models": "µs per request of one frame"}

if __name__ == "__main__":
    main()
