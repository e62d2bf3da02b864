"""What each mechanism of fits and lifts buys: errors and seconds without it, on many captures.

    python -m benchmarks.ablation --draws 0 10 --data DIRECTORY --json ROWS.json
    python -m benchmarks.ablation --show ROWS.json MORE.json

Captures are drawn (`benchmarks/drawn_captures.py`, `benchmarks/moving_captures.py`; motions of both
halves) and the real ones of a folder. Each is fitted and lifted with everything, and then without
one mechanism of `benchmarks/mechanisms.py` at a time. A mechanism that changes nothing in a fit is
not asked: without it the fit is the same. With several views of each frame cameras decide, so
mechanisms of cameras are judged by the first answer of a fit, or where cameras move by `FEW_STEPS`.
What the network and lifts buy is shown by fits of the default configuration, which also lift the
first view alone.

Errors are those of structures aligned frame by frame, as shares of the subject's height. A gain is
the mean log ratio of errors without and with a mechanism, `SLACK` of the height granted to both.
"""

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import fields_beside, read_capture
from benchmarks.drawn_captures import HEIGHT, Draw, draw_capture, radius
from benchmarks.draws import in_pool
from benchmarks.figures import print_table
from benchmarks.mechanisms import MECHANISMS
from benchmarks.motions import HALVES
from benchmarks.moving_captures import ANY, draw_moving
from benchmarks.switching import GEOMETRY, LIFT, NETWORK, Mechanism, observed
from models.calibrating.image_sizes import ImageSizes
from models.capture.metrics import procrustes_by_size
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import Trainer

Float64 = NDArray[np.float64]

EVERYTHING = "everything"
FEW_STEPS = 150
MOST_FRAMES = 200  # of a real capture, evenly
SLACK = 0.0005
FEWEST = 4  # keypoints of a frame, to align it
WORTH = 0.01  # a mechanism buys something where errors fall by more
REAL = "real"


class Job(NamedTuple):
    """One capture, and what is asked of it."""

    source: str  # a half of the motions, with "moving" behind it or not, or `REAL`
    name: str  # number of the draw, or of the file
    data: Path | None
    stages: tuple[str, ...]
    only: tuple[str, ...]


class Taken(NamedTuple):
    """A capture with its truth, which no fit sees."""

    keypoints: Float64  # (N, K, P, 2)
    confidence: NDArray[np.float32] | None
    times: Float64 | None
    sizes: ImageSizes | None
    edges: NDArray[np.int64] | None
    points3d: Float64  # (N, P, 3)
    cell: str


class Row(NamedTuple):
    """Errors of one capture without one mechanism."""

    source: str
    name: str
    cell: str
    stage: str
    mechanism: str
    acts: bool
    twice: float  # error where two views or more see a keypoint
    once: float  # and where one does
    alone: float  # of lifts of the first view alone; NaN with few steps
    seconds: float  # of processor time: the fit, or the lift


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure what each mechanism buys.")
    parser.add_argument("--draws", type=int, nargs=2, default=(0, 20), help="of each half")
    parser.add_argument("--moving", type=int, nargs=2, default=(0, 10), help="draws that move")
    parser.add_argument("--real", nargs="*", default=[], help="captures of --data")
    parser.add_argument("--data", type=Path, help="folder of captures with `points3d`")
    parser.add_argument("--stages", nargs="+", default=[LIFT, GEOMETRY, NETWORK])
    parser.add_argument("--only", nargs="+", default=[], help="these mechanisms alone")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--show", type=Path, nargs="+", help="show results that were written")
    arguments = parser.parse_args()
    if arguments.show:
        rows = [Row(**row) for path in arguments.show for row in json.loads(path.read_text())]
    else:
        rows = []
        for found in in_pool(measure, _jobs(arguments), arguments.processes):
            rows += found
            print(f"{found[0].source} {found[0].name}: {found[0].cell}", flush=True)
            if arguments.json:
                text = json.dumps([row._asdict() for row in rows])
                arguments.json.write_text(text + "\n")
    print_table("Gains, per cent", list(gains(rows)))


def _jobs(arguments: argparse.Namespace) -> Iterator[Job]:
    asked = (arguments.data, tuple(arguments.stages), tuple(arguments.only))
    for number in range(*arguments.draws):
        for half in HALVES:
            yield Job(half, str(number), *asked)
    for number in range(*arguments.moving):
        for half in HALVES:
            yield Job(f"{half} moving", str(number), *asked)
    for name in arguments.real:
        yield Job(REAL, name, *asked)


def measure(job: Job) -> list[Row] | None:
    """Fit and lift a capture with everything, and without one mechanism at a time."""
    taken = taken_of(job)
    if taken is None:
        return None
    rows = []
    asked = [one for one in MECHANISMS if not job.only or one.name in job.only]
    for stages, config in (((LIFT, NETWORK), FitConfig()), ((GEOMETRY,), _short())):
        chosen = [one for one in asked if one.stage in stages and one.stage in job.stages]
        if chosen:
            rows += _without_each(job, taken, config, chosen)
    return rows


def _short() -> FitConfig:
    return FitConfig(steps=FEW_STEPS)


def _without_each(
    job: Job, taken: Taken, config: FitConfig, mechanisms: Sequence[Mechanism]
) -> list[Row]:
    whole = config.steps != FEW_STEPS
    with observed(mechanisms) as acting:
        prior, seconds = fitted(taken, config)
        full, lift_seconds = errors_of(prior, taken, alone=whole)
    stage = NETWORK if whole else GEOMETRY
    here = (job.source, job.name, taken.cell)
    rows = [Row(*here, stage, EVERYTHING, True, *full, seconds)]
    if whole:
        rows.append(Row(*here, LIFT, EVERYTHING, True, *full, lift_seconds))
    saved = prior.to_bytes()
    for mechanism in mechanisms:
        if mechanism.name not in acting:
            rows.append(Row(*here, mechanism.stage, mechanism.name, False, *full, seconds))
            continue
        changed = config.model_copy(update=dict(mechanism.settings))
        with mechanism.off():
            if mechanism.stage == LIFT:
                errors, took = errors_of(FittedPrior.from_bytes(saved), taken, alone=whole)
            else:
                other, took = fitted(taken, changed)
                errors, _ = errors_of(other, taken, alone=whole)
        rows.append(Row(*here, mechanism.stage, mechanism.name, True, *errors, took))
    return rows


def fitted(taken: Taken, config: FitConfig) -> tuple[FittedPrior, float]:
    """Return the prior of a fit, or of its first answer with `FEW_STEPS`, and its seconds."""
    started = time.process_time()
    trainer = Trainer(
        taken.keypoints,
        config,
        confidence=taken.confidence,
        times=taken.times,
        image_sizes=taken.sizes,
        edges=taken.edges,
    )
    prior = None
    for _ in trainer.run():
        if config.steps == FEW_STEPS and trainer.has_first_answer:
            prior = trainer.first_answer()
            break
    return prior or trainer.result(), time.process_time() - started


def errors_of(
    prior: FittedPrior, taken: Taken, *, alone: bool
) -> tuple[tuple[float, float, float], float]:
    """Return the errors of lifts, as in `Row`, and the seconds of the first."""
    seen = np.asarray(np.isfinite(taken.keypoints).all(-1))
    views = seen.sum(1)  # (N, P)
    started = time.process_time()
    lift = prior.lift(taken.keypoints, confidence=taken.confidence, times=taken.times)
    seconds = time.process_time() - started
    points = lift.points3d.astype(np.float64)
    twice = _error(points, taken, np.asarray(views > 1))
    once = _error(points, taken, np.asarray(views == 1))
    single = float("nan")
    if alone:
        trust = None if taken.confidence is None else taken.confidence[:, :1]
        first = prior.lift(taken.keypoints[:, :1], confidence=trust, views=[0])
        single = _error(first.points3d.astype(np.float64), taken, seen[:, 0])
    return (twice, once, single), seconds


def _error(points: Float64, taken: Taken, asked: NDArray[np.bool_]) -> float:
    """Mean distance of keypoints `asked` (N, P) over the subject's height, whole frames aligned."""
    known = np.isfinite(points).all(-1) & np.isfinite(taken.points3d).all(-1)
    known &= known.sum(1, keepdims=True) >= FEWEST
    moved = procrustes_by_size(points, np.where(known[..., None], taken.points3d, np.nan))
    errors = np.linalg.norm(moved - taken.points3d, axis=-1)[asked & known]
    if not len(errors):
        return float("nan")
    return float(errors.mean() / (HEIGHT * radius(taken.points3d)))


def taken_of(job: Job) -> Taken | None:
    """Return the capture of a job; None where there is none of that number or name."""
    if job.source == REAL:
        return _real(job)
    half = job.source.split()[0]
    if "moving" in job.source:
        draw: Draw | None = draw_moving(int(job.name), job.data, half, ANY)
    else:
        draw = draw_capture(int(job.name), job.data, half)
    if draw is None:
        return None
    kind = "moving" if draw.moving else "pair" if draw.keypoints.shape[1] == 2 else "static"
    return Taken(
        draw.keypoints, None, draw.times, draw.sizes, None, draw.points3d, f"{half} {kind}"
    )


def _real(job: Job) -> Taken | None:
    path = (job.data or Path()) / f"{job.name}.npz"
    if not path.exists():
        return None
    capture, beside = read_capture(path), fields_beside(path)
    if capture.points3d is None:
        return None
    count = len(capture.keypoints)
    some = np.linspace(0, count - 1, min(count, MOST_FRAMES)).astype(int)
    sizes = beside.get("image_sizes")
    edges = beside.get("edges")
    return Taken(
        capture.keypoints[some].astype(np.float64),
        None if capture.confidence is None else capture.confidence[some],
        None,
        None if not sizes or sizes[0] is None else [(int(w), int(h)) for w, h in sizes],
        None if not edges else np.array(edges, np.int64),
        capture.points3d[some].astype(np.float64),
        job.name,
    )


def gains(rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """Yield a row per mechanism: its lines, where it acts, what it buys in each cell.

    A cell has the gain where two views see, where one does, and of the first view alone, in per
    cent. "-" stands for a cell in which it acts on no capture.
    """
    known = {(row.source, row.name, row.stage): row for row in rows if row.mechanism == EVERYTHING}
    cells = sorted({row.cell for row in rows})
    for mechanism in MECHANISMS:
        own = [row for row in rows if row.mechanism == mechanism.name]
        if not own:
            continue
        acting = [row for row in own if row.acts]
        whole = [known[row.source, row.name, mechanism.stage] for row in acting]
        saved = [full.seconds - row.seconds for row, full in zip(acting, whole, strict=True)]
        table = {
            "mechanism": mechanism.name,
            "lines": mechanism.lines,
            "acts in": f"{len(acting)} of {len(own)}",
            "seconds": f"{np.mean(saved):.2f}" if saved else "-",
        }
        for cell in cells:
            pairs = [
                (row, full) for row, full in zip(acting, whole, strict=True) if row.cell == cell
            ]
            table[cell] = _in_cell(pairs, sum(row.cell == cell for row in own))
        yield table


def _in_cell(pairs: Sequence[tuple[Row, Row]], count: int) -> str:
    """Return three gains in per cent; where the mechanism does not act, a capture gains 0."""
    if not pairs:
        return "-"
    figures = []
    for part in ("twice", "once", "alone"):
        logs = [
            math.log((getattr(row, part) + SLACK) / (getattr(full, part) + SLACK))
            for row, full in pairs
            if math.isfinite(getattr(row, part)) and math.isfinite(getattr(full, part))
        ]
        figures.append(f"{100 * sum(logs) / count:.1f}" if logs else "")
    return " / ".join(figures).rstrip(" /")


if __name__ == "__main__":
    main()
