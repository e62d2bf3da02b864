"""How far points are off, beside how far lifts expect them to be.

    python -m benchmarks.doubt --half setting looking --data FOLDER [--harmed] [--picture FILE]
    python -m benchmarks.doubt --captures --data FOLDER

Draws (`drawn_captures.py`) or cells of captures (`real_cells.py`) are fitted and lifted, and the
truth is held against the answers (`coverage.py`). It takes no part in any fit.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.coverage import ENDS, Held, covariance_of, held, ratio_scores, shares
from benchmarks.drawn_captures import HEIGHT, Draw, radius
from benchmarks.draws import add_options, in_pool, of_draws
from benchmarks.figures import print_table
from benchmarks.harmed_frames import area_for_worst, errors_of
from benchmarks.motions import HALVES
from benchmarks.real_cells import Cell, cells, load
from benchmarks.reliability import Curve, draw_reliability
from models.lifting.fit_report import fit_report
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.8, 0.9, 0.95)
SHOWN = (0.5, 0.68, 0.95)  # of the levels, in tables
MOST_FRAMES = 60  # that some of the views lift
FAIR = {"draws": (0.53, 0.83), "cells": (0.55, 0.81)}  # of the points within their 68 %
NAN = float("nan")
TITLES = {"points": "points that two views or more show", "ratios": "log ratios of two lengths"}


@dataclass(frozen=True)
class Row:
    """What was found of one draw or cell; NaN where there was nothing to count."""

    name: str
    words: str
    half: str  # of the motions; empty: of neither
    views: int
    points: list[float]  # share of the points that two views show within each of `LEVELS`
    ratios: list[float]  # the same of log ratios of two lengths
    once: float  # share of the points that one view shows within the distance of 68 %
    never: float  # the same of points that no view shows
    rank: float  # correlation of error and deviation in frames, by ranks
    error: float  # of the subject's height, root mean square, of points that two views show
    expected: float
    largest: float  # deviation of a point, of the subject's height
    subsets: float = NAN  # rank correlation of expected and true error over subsets of the views
    quality: float = NAN  # area under the curve of `quality` for the worst tenth of harmed frames


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    rows = [Row(**row) for path in arguments.add for row in json.loads(path.read_text())]
    for row in _measured(arguments):
        rows.append(row)
        print(_line(row), flush=True)
        if arguments.json:  # again and again: a long run may be ended
            arguments.json.write_text(json.dumps([asdict(one) for one in rows]) + "\n")
    print_table(
        "How well deviations hold", summary(rows, "cells" if arguments.captures else "draws")
    )
    if arguments.picture:
        draw_reliability(LEVELS, curves(rows), arguments.picture)


def _measured(arguments: argparse.Namespace) -> Iterator[Row]:
    if arguments.captures:
        every = cells()
        some = [every[n] for n in arguments.only] if arguments.only else every
        yield from in_pool(partial(_of_cell, arguments), some, arguments.processes)
        return
    for half in arguments.half or [None]:
        for row in of_draws(_of_draw, arguments, half):
            yield replace(row, half=half or "")


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Hold errors against expected ones.")
    add_options(parser)
    parser.add_argument("--half", choices=HALVES, nargs="+", help="draw the motions of these")
    parser.add_argument(
        "--captures",
        action="store_true",
        help="cells of captures, not draws; --only has their numbers",
    )
    parser.add_argument("--harmed", action="store_true", help="also measure quality of frames")
    parser.add_argument("--picture", type=Path, help="draw nominal and observed shares, as SVG")
    parser.add_argument(
        "--add", type=Path, nargs="+", default=[], help="results of earlier runs, from --json"
    )
    return parser.parse_args()


def _of_draw(draw: Draw, arguments: argparse.Namespace) -> Row | None:
    prior = fit(draw.keypoints, FitConfig(), image_sizes=draw.sizes)
    name = str(draw.number)
    return measure(prior, draw.keypoints, draw.points3d, name, draw.words, arguments.harmed)


def _of_cell(arguments: argparse.Namespace, cell: Cell) -> Row | None:
    loaded = load(cell, arguments.data)
    if loaded is None:
        return None
    prior = fit(loaded.keypoints, loaded.config, image_sizes=loaded.sizes)
    return measure(prior, loaded.keypoints, loaded.truth, cell.name, cell.words, arguments.harmed)


def measure(
    prior: FittedPrior, keypoints: Float64, truth: Float64, name: str, words: str, harmed: bool
) -> Row | None:
    """Hold the answers of a fit to its own keypoints (N, K, P, 2) against the truth (N, P, 3).

    None where no point that two views show has a deviation. Points are counted in frames that have
    four such points or more, by which the truth is aligned.
    """
    lift = prior.lift(keypoints, uncertainty="full")
    showing = np.isfinite(keypoints).all(-1).sum(1)  # (N, P)
    known = np.isfinite(truth).all(-1) & np.isfinite(lift.points3d_sd)
    aligning = known & (showing > 1)
    there = np.flatnonzero(aligning.sum(1) >= ENDS).tolist()
    if not len(there):
        return None
    rng = np.random.default_rng(0)
    frames, ratios = [], []
    for n in there:
        some, by = known[n], aligning[n]
        answer, true = lift.points3d[n].astype(np.float64), truth[n]
        frames.append(held(answer[some], true[some], _covariance(lift, n, some), by[some]))
        ratios.append(ratio_scores(answer[by], true[by], _covariance(lift, n, by), rng))
    points = Held(*map(np.concatenate, zip(*frames, strict=True)))
    shown = showing[there][known[there]]
    twice = shown > 1
    unit = HEIGHT * radius(np.where(aligning[..., None], lift.points3d, np.nan)[there])
    return Row(
        name=name,
        words=words,
        half="",
        views=keypoints.shape[1],
        points=shares(points.distances[twice], 3, LEVELS),
        ratios=shares(np.concatenate(ratios), 1, LEVELS),
        once=_near(points, shown == 1),
        never=_near(points, shown == 0),
        rank=_rank(
            frames, [by[some] for by, some in zip(aligning[there], known[there], strict=True)]
        ),
        error=_root_mean(points.errors[twice]) / unit,
        expected=_root_mean(points.expected[twice]) / unit,
        largest=float(np.nanmax(lift.points3d_sd)) / unit,
        subsets=_rank_of_subsets(prior, lift, keypoints, truth),
        quality=area_for_worst(prior, keypoints, truth, rng) if harmed else NAN,
    )


def _covariance(lift: LiftedFrames, n: int, some: Bool) -> Float64:
    blocks, modes = lift.points3d_covariance[n, some], lift.points3d_modes[n, some]
    return covariance_of(blocks.astype(np.float64), modes.astype(np.float64))


def _near(points: Held, which: Bool) -> float:
    """Return how many of some points are within the distance of 68 %, if all ways are as likely."""
    scores = 3 * np.square(points.errors[which] / points.expected[which])
    return shares(scores, 3, (SHOWN[1],))[0]


def _rank(frames: Sequence[Held], aligning: Sequence[Bool]) -> float:
    """Return the mean correlation of errors and deviations in frames, by ranks."""
    ranks = [
        spearmanr(frame.errors[by], frame.expected[by]).statistic
        for frame, by in zip(frames, aligning, strict=True)
    ]
    return float(np.nanmean(ranks))


def _root_mean(values: Float64) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _rank_of_subsets(
    prior: FittedPrior, lift: LiftedFrames, keypoints: Float64, truth: Float64
) -> float:
    """Return the rank correlation of expected and true error over choices of two views or more.

    NaN of pairs, and where the expected errors are not known.
    """
    chosen = [
        worth for worth in fit_report(prior, lift, keypoints).of_views if len(worth.views) > 1
    ]
    if len(chosen) < len("abc"):
        return NAN
    count = len(keypoints)
    frames = np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).astype(int))
    true = []
    for worth in chosen:
        views = list(worth.views)
        some = prior.lift(keypoints[frames][:, views], views=views)
        errors = errors_of(some.points3d.astype(np.float64), truth[frames])
        true.append(_root_mean(errors[np.isfinite(errors)]))
    return float(spearmanr([worth.expected_error for worth in chosen], true).statistic)


def summary(rows: Sequence[Row], kind: str) -> list[dict[str, Any]]:
    """Return medians over draws or cells: of all, and of some that have something in common."""
    groups = {
        "all": list(rows),
        "pairs": [row for row in rows if row.views == 2],
        "three views or more": [row for row in rows if row.views > 2],
        "with gaps": [row for row in rows if "gaps" in row.words],
        "cameras found": [row for row in rows if "cameras found" in row.words],
        "cameras given": [row for row in rows if "cameras given" in row.words],
    }
    return [_medians(name, some, kind) for name, some in groups.items() if some]


def _medians(name: str, rows: Sequence[Row], kind: str) -> dict[str, Any]:
    low, high = FAIR[kind]
    places = [LEVELS.index(level) for level in SHOWN]
    within = np.array([row.points for row in rows])[:, places]
    ratios = np.array([row.ratios for row in rows])[:, places]
    fair = (low <= within[:, 1]) & (within[:, 1] <= high)
    return {
        kind: f"{len(rows)}, {name}",
        "points in 50 / 68 / 95 %": " ".join(_middle(column, ".0%") for column in within.T),
        "ratios": " ".join(_middle(column, ".0%") for column in ratios.T),
        f"68 % is {100 * low:.0f} to {100 * high:.0f}": f"{fair.mean():.0%}",
        "one view": _middle([row.once for row in rows], ".0%"),
        "no view": _middle([row.never for row in rows], ".0%"),
        "rank": _middle([row.rank for row in rows], ".2f"),
        "error / expected": _middle([row.error / row.expected for row in rows], ".2f"),
        "largest": _middle([row.largest for row in rows], ".0%"),
        "subsets": _middle([row.subsets for row in rows], ".2f"),
        "quality": _middle([row.quality for row in rows], ".2f"),
    }


def _middle(values: Sequence[float] | Float64, form: str) -> str:
    """Return the median of what is known in this format."""
    known = [value for value in values if np.isfinite(value)]
    return format(np.median(known), form) if known else ""


def curves(rows: Sequence[Row]) -> list[Curve]:
    """Return the medians over the draws of each half."""
    found = []
    for name, title in TITLES.items():
        for half in HALVES:
            shares_of = [getattr(row, name) for row in rows if row.half == half]
            if shares_of:
                found.append(Curve(half, title, np.nanmedian(shares_of, 0)))
    return found


def _line(row: Row) -> str:
    def percent(values: Sequence[float]) -> str:
        return " ".join(f"{values[LEVELS.index(level)]:.0%}" for level in SHOWN)

    figures = {
        "points": percent(row.points),
        "ratios": percent(row.ratios),
        "one view": f"{row.once:.0%}",
        "no view": f"{row.never:.0%}",
        "rank": f"{row.rank:.2f}",
        "error": f"{100 * row.error:.2g} %",
        "expected": f"{100 * row.expected:.2g} %",
        "largest": f"{row.largest:.0%}",
        "subsets": f"{row.subsets:.2f}",
        "quality": f"{row.quality:.2f}",
    }
    known = [f"{name} {figure}" for name, figure in figures.items() if "nan" not in figure]
    return f"{row.name} {row.words} | {' | '.join(known)}"


if __name__ == "__main__":
    main()
