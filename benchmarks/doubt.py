"""How far points are off, beside how far lifts expect them to be, on drawn rigs and motions.

    python -m benchmarks.doubt --help

Each draw (`benchmarks/drawn_captures.py`) is fitted with the default configuration and lifted.
Errors are those of structures aligned frame by frame. `points3d_sd` is a distance, root mean
square: if an error is as likely in all directions, half of the points are within 0.89 times it,
68 % within 1.08 times and 95 % within 1.61 times. The truth takes no part in any fit.
"""

import argparse
import json
import traceback
import warnings
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, spearmanr

from benchmarks.drawn_captures import Draw, draw_capture
from benchmarks.figures import print_table
from benchmarks.motions import HALVES
from models.capture.metrics import procrustes_by_size
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]
SHARES = (0.5, 0.68, 0.95)
FEWEST = 4  # keypoints of a frame that two views see, for the frame to count
FAIR = (0.53, 0.83)  # of the points within the distance of 68 %


class Row(NamedTuple):
    """The points of a draw."""

    number: int
    words: str
    error: float  # of the subject's height, root mean square
    expected: float
    within: list[float]  # share of the points within each distance of `SHARES`
    once: float  # the same of 68 %, of points that one view sees
    rank: float  # correlation of errors and deviations in frames, by ranks


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Hold errors against expected ones.")
    parser.add_argument("--draws", type=int, nargs=2, default=(0, 60), help="first and end")
    parser.add_argument("--half", choices=HALVES, help="draw the motions of this half")
    parser.add_argument("--data", type=Path, help="folder of captures with `points3d`")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the results to this file")
    arguments = parser.parse_args()
    jobs = [(number, arguments) for number in range(*arguments.draws)]
    rows = []
    with get_context("spawn").Pool(arguments.processes, _quiet) as pool:
        for row in pool.imap(_measured, jobs):
            if row is not None:
                rows.append(row)
                print(_line(row), flush=True)
    if rows:
        print_table("Points that two views or more see", summary(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps([row._asdict() for row in rows]) + "\n")


def _quiet() -> None:
    warnings.simplefilter("ignore")
    use_threads(1)


def _measured(job: tuple[int, argparse.Namespace]) -> Row | None:
    number, arguments = job
    draw = draw_capture(number, arguments.data, arguments.half)
    if draw is None:
        return None
    try:
        return measure(draw)
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError):
        print(f"draw {number}: {traceback.format_exc()}", flush=True)
        return None


def measure(draw: Draw) -> Row | None:
    """Fit and lift a draw; None where no point has a deviation."""
    lift = fit(draw.keypoints, FitConfig(), image_sizes=draw.sizes).lift(draw.keypoints)
    views = np.isfinite(draw.keypoints).all(-1).sum(1)  # (N, P)
    known = np.isfinite(draw.points3d).all(-1) & np.isfinite(lift.points3d_sd)
    twice = known & (views > 1)
    twice &= twice.sum(1, keepdims=True) >= FEWEST
    if not twice.any():
        return None
    truth = np.where(twice[..., None], draw.points3d, np.nan)
    points = lift.points3d.astype(np.float64)
    # The truth is brought to the answer, so errors have the unit of the deviations.
    aligned = procrustes_by_size(draw.points3d, np.where(twice[..., None], points, np.nan))
    errors = np.linalg.norm(aligned - points, axis=-1)
    expected = lift.points3d_sd.astype(np.float64)
    once = known & (views == 1) & twice.any(1, keepdims=True)
    there = twice.any(1)
    ours = _sizes(np.where(twice[..., None], points, np.nan)[there])
    unit = draw.height * np.median(ours) / np.median(_sizes(truth[there]))
    ranks = [
        spearmanr(error[seen], sd[seen]).statistic
        for error, sd, seen in zip(errors, expected, twice, strict=True)
        if seen.any()
    ]
    return Row(
        draw.number,
        draw.words,
        float(np.sqrt(np.square(errors[twice]).mean()) / unit),
        float(np.sqrt(np.square(expected[twice]).mean()) / unit),
        [_within(errors[twice], expected[twice], share) for share in SHARES],
        _within(errors[once], expected[once], SHARES[1]),
        float(np.nanmean(ranks)),
    )


def _sizes(points: Float64) -> Float64:
    """Return the root-mean-square radius of structures (N, P, 3)."""
    return np.asarray(np.sqrt(np.nansum(np.nanvar(points, 1), -1)))


def _within(errors: Float64, expected: Float64, share: float) -> float:
    """Return how many errors are within the distance that so large a share should be."""
    if not len(errors):
        return float("nan")
    return float((np.square(errors) < chi2.ppf(share, 3) / 3 * np.square(expected)).mean())


def summary(rows: list[Row]) -> list[dict[str, Any]]:
    """Medians over draws, of pairs and of more views."""
    kinds = {
        "three views or more": [row for row in rows if " 2 views" not in row.words],
        "pairs": [row for row in rows if " 2 views" in row.words],
    }
    return [
        {
            "draws": name,
            "number": len(some),
            **{
                f"within {100 * share:.0f} %": f"{np.median([row.within[n] for row in some]):.0%}"
                for n, share in enumerate(SHARES)
            },
            "68 % is 53 to 83": f"{_share_of_fair(some):.0%}",
            "one view: 68 %": f"{np.nanmedian([row.once for row in some]):.0%}",
            "error over expected": f"{np.median([row.error / row.expected for row in some]):.2f}",
            "rank": f"{np.median([row.rank for row in some]):.2f}",
        }
        for name, some in kinds.items()
        if some
    ]


def _share_of_fair(rows: list[Row]) -> float:
    return float(np.mean([FAIR[0] < row.within[1] < FAIR[1] for row in rows]))


def _line(row: Row) -> str:
    within = " ".join(f"{share:.0%}" for share in row.within)
    figures = f"error {row.error:.2%} expected {row.expected:.2%} within {within}"
    return f"{row.number} {row.words} | {figures} one view {row.once:.0%} rank {row.rank:.2f}"


if __name__ == "__main__":
    main()
