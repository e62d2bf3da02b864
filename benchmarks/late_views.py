"""Whether views out of step are found, on drawn films whose cameras stand, pan or are carried.

    python -m benchmarks.late_views --half setting --draws 0 60 --data MOTIONS [--no-times]

Half of the films (`benchmarks/late_captures.py`) are in step; of the others a view or two are late
by 0.3 to 450 frames. No fit is made. An offset is found if it is within a frame of the truth.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.draws import add_options, in_pool
from benchmarks.figures import print_table
from benchmarks.late_captures import draw_film
from benchmarks.motions import HALVES
from models.findings.finding import Finding
from models.training.synchronising import put_in_step

Float64 = NDArray[np.float64]
FPS = 30.0  # that the fit believes, if it knows times
NEAR = 1.0  # frames
OUTCOMES = ("in step", "found", "unknown", "missed", "false alarm", "wrong and sure")


class Row(NamedTuple):
    """What was found of a film."""

    number: int
    words: str
    late: bool
    static: bool  # whether its cameras stand
    outcome: str
    seconds: float  # of the processor


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_options(parser)
    parser.add_argument("--half", choices=HALVES, default=HALVES[0], help="motions")
    parser.add_argument("--no-times", action="store_true", help="do not give the frame rate")
    arguments = parser.parse_args()
    numbers = arguments.only or range(*arguments.draws)
    measure = partial(_measured, arguments.half, arguments.data, not arguments.no_times)
    rows = []
    for row in in_pool(measure, numbers, arguments.processes):
        rows.append(row)
        print(f"{row.number} | {row.outcome} | {row.seconds:.1f} s | {row.words}", flush=True)
    print_table(
        "Films",
        [_summary(rows, late, static) for late in (False, True) for static in (True, False)],
    )
    if arguments.json:
        arguments.json.write_text(json.dumps([row._asdict() for row in rows]) + "\n")


def _measured(half: str, data: Path | None, timed: bool, number: int) -> Row:
    film = draw_film(number, half, data)
    times = np.arange(len(film.keypoints)) / FPS if timed else None
    started = time.process_time()
    read = put_in_step(film.keypoints.astype(np.float32), None, times, "auto")
    seconds = time.process_time() - started
    late = bool(film.late.any())
    outcome = _outcome(film.late, read.findings)
    return Row(number, film.words, late, film.kind == "static", outcome, seconds)


def _outcome(late: Float64, findings: tuple[Finding, ...]) -> str:
    """Compare what was found with by how many frames views (K,) are late."""
    found, sure, unknown = np.zeros(len(late)), np.zeros(len(late), bool), False
    for finding in findings:
        if finding.code == "views_out_of_step":
            sure[list(finding.views)] = True
            found[list(finding.views)] = finding.evidence["offset_frames"]
        unknown |= finding.code == "timing_unknown"
    errors = np.abs(_relative(found) - _relative(late))
    if (sure & (errors > NEAR)).any():
        return "wrong and sure" if late.any() else "false alarm"
    if unknown:
        return "unknown"
    if not late.any():
        return "in step"
    return "found" if errors.max() <= NEAR else "missed"


def _relative(offsets: Float64) -> Float64:
    return offsets - (offsets[0] if len(offsets) == 2 else np.median(offsets))


def _summary(rows: list[Row], late: bool, static: bool) -> dict[str, Any]:
    some = [row.outcome for row in rows if row.late is late and row.static is static]
    words = f"{'late' if late else 'in step'}, cameras {'stand' if static else 'move'}"
    return {"films": words, "number": len(some)} | {each: some.count(each) for each in OUTCOMES}


if __name__ == "__main__":
    main()
