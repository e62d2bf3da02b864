"""Captures that nobody would film, fitted and lifted: nothing may fail, and a finding is due.

    python -m benchmarks.odd_captures [--draws 0 300]

Each numbered draw has few or many frames, views and keypoints, and some of the oddities of `drawn`,
such as points on a line, repeated frames, keypoints never seen and coordinates in shares of the
image. Warnings of NumPy count as errors. Draws that are refused, with the reason, are listed apart.
"""

import argparse
import time
import traceback
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Bar, Results, Row, command
from models.capture.checks import capture_findings
from models.lifting.fitted_prior import FittedPrior
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]
Change = Callable[[Float64, np.random.Generator], Any]

IMAGE = (1280, 1024)
QUICK = FitConfig(steps=20, batch_size=16)
FARTHEST = 20.0  # sides of the image, for a reprojection
HARMLESS = {"gaps", "rounded"}  # good captures have them, too: no finding is due


def _left_out(keypoints: Float64, those: NDArray[np.bool_]) -> None:
    keypoints[those] = np.nan


def _mirrored(keypoints: Float64, _: np.random.Generator) -> None:
    keypoints[:, 0, :, 0] = IMAGE[0] - keypoints[:, 0, :, 0]


def _thrown(keypoints: Float64, rng: np.random.Generator) -> None:
    """Throw a tenth of the keypoints somewhere else."""
    those = rng.random(keypoints.shape[:3]) < 0.1
    keypoints[those] += 500 * rng.normal(size=(int(those.sum()), 2))


# Of the points (N, P, 3): a share of the draws, and a change in place.
OF_POINTS: dict[str, tuple[float, Change]] = {
    "on a line": (0.1, lambda points, _: np.multiply(points[..., :1], [1, 0.3, 0.2], out=points)),
    "in a plane": (0.1, lambda points, _: np.multiply(points, [1, 1, 0], out=points)),
    "rigid": (0.1, lambda points, _: np.copyto(points, points[:1])),
    "repeated frames": (0.1, lambda points, _: np.copyto(points[1::2], points[:-1:2])),
    "twins": (0.1, lambda points, _: np.copyto(points[:, 1], points[:, 0])),
}
# Of the keypoints (N, K, P, 2).
OF_KEYPOINTS: dict[str, tuple[float, Change]] = {
    "rounded": (0.15, lambda seen, _: np.round(seen, out=seen)),
    "gaps": (0.2, lambda seen, rng: _left_out(seen, rng.random(seen.shape[:3]) < 0.4)),
    "hardly seen": (0.05, lambda seen, rng: _left_out(seen, rng.random(seen.shape[:3]) < 0.8)),
    "view never seen": (0.1, lambda seen, _: seen[:, -1].fill(np.nan)),
    "keypoint never seen": (0.15, lambda seen, _: seen[:, :, -1].fill(np.nan)),
    "empty frames": (0.15, lambda seen, rng: _left_out(seen, rng.random(len(seen)) < 0.5)),
    "one frame seen": (0.05, lambda seen, _: seen[1:].fill(np.nan)),
    "all at one pixel": (0.03, lambda seen, _: seen.fill(7.0)),
    "nothing seen": (0.03, lambda seen, _: seen.fill(np.nan)),
    "huge": (0.05, lambda seen, _: np.multiply(seen, 100, out=seen)),
    "tiny": (0.05, lambda seen, _: np.multiply(seen, 1e-4, out=seen)),
    "shares of the image": (0.05, lambda seen, _: np.divide(seen, IMAGE, out=seen)),
    "frozen view": (0.1, lambda seen, _: np.copyto(seen[:, 0], seen[:1, 0])),
    "mirrored view": (0.1, _mirrored),
    "same views": (0.1, lambda seen, _: np.copyto(seen[:, -1], seen[:, 0])),
    "outliers": (0.15, _thrown),
}


class Odd(NamedTuple):
    """An odd capture."""

    keypoints: NDArray[np.float32]  # (N, K, P, 2)
    confidence: NDArray[np.float32] | None  # (N, K, P)
    sizes: list[tuple[int, int]] | None
    times: Float64 | None  # (N,) seconds
    oddities: list[str]


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)
    warnings.simplefilter("error")
    rows = []
    for number in range(*arguments.draws):
        rows.append(measure(number))
        print(rows[-1], flush=True)
    refused = [row for row in rows if row["refused"]]
    answered = [row for row in rows if not row["refused"]]
    bars = [
        Bar("draws that failed", 0, sum(bool(row["failed"]) for row in rows), ""),
        Bar("draws of oddities without a finding", 0, sum(map(unnoticed, answered)), ""),
        Bar("farthest reprojection", FARTHEST, max(row["farthest"] for row in rows), "sides"),
    ]
    tables = {"Refused": refused, "Failed": [row for row in rows if row["failed"]]}
    Results("odd_captures", vars(arguments), {k: v for k, v in tables.items() if v}, bars).publish(
        arguments.json
    )


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Fit and lift odd captures.")
    parser.add_argument("--draws", type=int, nargs=2, default=(0, 300), metavar=("FROM", "TO"))
    return parser.parse_args()


def unnoticed(row: Row) -> bool:
    """Whether a capture with oddities that may do harm has no finding."""
    odd = set(row["oddities"].split(", ")) - HARMLESS - {""}
    return bool(odd) and not row["findings"] and not row["failed"]


def measure(number: int) -> Row:
    """Return what became of a draw."""
    odd = drawn(number)
    row: Row = {
        "draw": number,
        "frames, views, keypoints": odd.keypoints.shape[:3],
        "oddities": ", ".join(odd.oddities),
        "findings": "",
        "refused": "",
        "failed": "",
        "farthest": 0.0,
    }
    began = time.perf_counter()
    try:
        row |= answered(odd)
    except ValueError as error:
        row["refused"] = str(error)[:100]
    except Exception:  # noqa: BLE001 - whatever it is, it must not be
        row["failed"] = traceback.format_exc()[-300:]
    return row | {"s": time.perf_counter() - began}


def answered(odd: Odd) -> Row:
    """Check, fit, store and lift a capture; return what was found."""
    early = capture_findings(odd.keypoints, odd.confidence, odd.sizes)
    fitted = fit(
        odd.keypoints, QUICK, confidence=odd.confidence, image_sizes=odd.sizes, times=odd.times
    )
    prior = FittedPrior.from_bytes(fitted.to_bytes())
    lift = prior.lift(odd.keypoints, confidence=odd.confidence)
    if np.isinf(lift.points3d).any():
        raise ArithmeticError("infinite structures")
    codes = {finding.code for finding in (*early, *prior.findings)}
    return {
        "findings": ", ".join(sorted(codes)),
        "farthest": float(np.nanmax(lift.reprojection_errors, initial=0)) / max(IMAGE),
    }


def drawn(number: int) -> Odd:
    """Return a numbered draw, the same everywhere."""
    rng = np.random.default_rng(number)
    frames, views = int(rng.choice([1, 2, 3, 5, 12, 40, 90])), int(rng.choice([1, 2, 2, 3, 4, 6]))
    count, moving = int(rng.choice([4, 5, 6, 16])), rng.random() < 0.5
    oddities: list[str] = []
    seconds = np.arange(frames)[:, None, None] / 30
    points = rng.normal(size=(1, count, 3)) + 0.2 * np.sin(
        seconds + rng.uniform(0, 6, (1, count, 3))
    )
    if rng.random() < 0.5:
        points += np.cumsum(rng.normal(size=(frames, 1, 3)) * 0.05, 0)
    _change(points, OF_POINTS, oddities, rng)
    focal, distance = 10 ** rng.uniform(2.5, 3.6), rng.choice([6, 10, 40, 1000])
    turns = rng.uniform(0, 2 * np.pi, views) + 0.02 * moving * np.arange(frames)[:, None]  # (N, K)
    cosines, sines = np.cos(turns)[..., None], np.sin(turns)[..., None]
    x, y, z = points[:, None, :, 0], points[:, None, :, 1], points[:, None, :, 2]
    depth = cosines * z - sines * x + distance
    keypoints = focal * np.stack((cosines * x + sines * z, y + 0 * depth), -1) / depth[..., None]
    keypoints += np.array(IMAGE) / 2
    keypoints += rng.normal(size=keypoints.shape) * rng.choice([0, 0, 0.5, 3, 20])
    _change(keypoints, OF_KEYPOINTS, oddities, rng)
    weights = rng.uniform(0, 1, keypoints.shape[:3]) if rng.random() < 0.2 else None
    return Odd(
        keypoints.astype(np.float32),
        None if weights is None else weights.astype(np.float32),
        [IMAGE] * views if rng.random() < 0.6 else None,
        seconds[:, 0, 0] if rng.random() < 0.4 else None,
        oddities,
    )


def _change(
    array: Float64,
    changes: dict[str, tuple[float, Change]],
    oddities: list[str],
    rng: np.random.Generator,
) -> None:
    """Make some changes in place, and note their names."""
    for name, (share, change) in changes.items():
        if rng.random() < share:
            change(array, rng)
            oddities.append(name)


if __name__ == "__main__":
    main()
