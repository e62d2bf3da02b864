"""How well views that are out of step are found, on any capture whose frames follow each other.

    python benchmarks/synchronisation.py CAPTURE.npz --fps 50 [--seeds 5] [--noise 0 5 15]
                                         [--fits] [--image-size WxH] [--json FILE]

One view of the capture, drawn by the seed, is made late by 1 to 10 frames, whole and fractional:
its keypoints are interpolated linearly between its frames, and noise is added. With `--fits`, a
fit of the late capture is compared with one of the capture as it is. The truth takes no part.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import Capture, CaptureError, read_capture
from benchmarks.figures import Bar, Results, Row, command
from models.capture.metrics import pa_mpjpe
from models.epipolar.synchronisation import find_timing
from models.numerics.threads import use_threads
from models.settings.config import Automatic, FitConfig
from models.training.synchronising import put_in_step
from models.training.trainer import fit

Float64 = NDArray[np.float64]

WHOLE = [float(late) for late in range(1, 11)]
FRACTIONS = [0.5, 1.3, 2.6, 3.5, 4.8, 5.4, 6.5, 7.7, 8.2, 9.5]
LATE_IN_FITS = (3.0, 6.5)


class Found(NamedTuple):
    """One late view, and what was found."""

    late: float  # frames
    error: float  # frames, of that view
    others: float  # frames, the largest offset of the other views
    sure: bool
    seconds: float  # of processor time


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)  # as in the service
    try:
        capture = read_capture(arguments.capture)
    except CaptureError as error:
        sys.exit(f"{arguments.capture.name}: {error}")
    rows: list[Row] = []
    bars: list[Bar] = []
    for noise in arguments.noise:
        for kind, lateness in (("whole", WHOLE), ("fractional", FRACTIONS)):
            found = [
                find(capture, late, noise, seed)
                for seed in range(arguments.seeds)
                for late in lateness
            ]
            rows.append(row_of(noise, kind, found))
            bars.append(bar_of(noise, kind, found))
    tables = {f"One view of {arguments.capture.stem} late": rows}
    if arguments.fits:
        tables["PA-MPJPE of fits, in the unit of the truth"], more = compare_fits(
            capture, arguments
        )
        bars += more
    Results("synchronisation", vars(arguments), tables, bars).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how late views are found to be.")
    parser.add_argument("capture", type=Path, help=".npz whose frames follow each other in time")
    parser.add_argument("--fps", type=float, default=30.0, help="default: %(default)s")
    parser.add_argument("--seeds", type=int, default=5, help="of views and noise: %(default)s")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 5.0, 15.0], help="pixels")
    parser.add_argument("--fits", action="store_true", help="fit late captures, too")
    parser.add_argument("--steps", type=int, help="of the fits; default: the configuration's")
    parser.add_argument("--image-size", help="WxH of every view, if the file does not say")
    return parser.parse_args()


def make_late(keypoints: Float64, view: int, late: float) -> Float64:
    """Return keypoints (N, K, P, 2) of which a view shows what it showed `late` frames before."""
    moments = np.arange(len(keypoints)) - late
    before = np.floor(moments).astype(int)
    share = (moments - before)[:, None, None]
    after = before + (share[:, 0, 0] > 0)
    inside = (before >= 0) & (after < len(keypoints))
    first, second = (np.clip(place, 0, len(keypoints) - 1) for place in (before, after))
    shown = (1 - share) * keypoints[first, view] + share * keypoints[second, view]
    changed = keypoints.copy()
    changed[:, view] = np.where(inside[:, None, None], shown, np.nan)
    return changed


def harmed(capture: Capture, late: float, noise: float, seed: int) -> tuple[Float64, int]:
    """Return the keypoints with one view late and noise, and which view that is."""
    rng = np.random.default_rng([seed, round(10 * late), round(noise)])
    view = int(rng.integers(capture.keypoints.shape[1]))
    keypoints = make_late(capture.keypoints.astype(np.float64), view, late)
    return keypoints + noise * rng.standard_normal(keypoints.shape), view


def find(capture: Capture, late: float, noise: float, seed: int) -> Found:
    """Make a view late, and look for it."""
    keypoints, view = harmed(capture, late, noise, seed)
    weights = np.isfinite(keypoints).all(-1) * 1.0
    started = time.process_time()
    timing = find_timing(keypoints, np.asarray(weights))
    seconds = time.process_time() - started
    offsets = np.zeros(keypoints.shape[1])
    if timing is not None:
        offsets = timing.offsets[np.abs(timing.offsets[:, view] - late).argmin()].copy()
    if len(offsets) == 2 and view == 0:  # of two views, the second is said to be early
        offsets = offsets - offsets[1]
    own, others = offsets[view], np.delete(offsets, view)
    sure = timing is not None and len(timing.frames) == 1 and bool(timing.late.any())
    return Found(late, abs(float(own) - late), float(np.abs(others).max()), sure, seconds)


def row_of(noise: float, kind: str, found: list[Found]) -> Row:
    """Summarise what was found."""
    errors = np.array([one.error for one in found if one.sure])
    return {
        "noise px": noise,
        "late by": kind,
        "cases": len(found),
        "sure": sum(one.sure for one in found),
        "median error": round(float(np.median(errors)), 3) if len(errors) else None,
        "largest error": round(float(errors.max()), 3) if len(errors) else None,
        "largest offset of others": round(max(one.others for one in found), 3),
        "seconds": round(float(np.median([one.seconds for one in found])), 2),
    }


def bar_of(noise: float, kind: str, found: list[Found]) -> Bar:
    """Return the share of cases that are good enough for so much noise."""
    if noise == 0:
        allowed = 0.0 if kind == "whole" else 0.2
        good = [one.sure and one.error <= allowed for one in found]
    elif noise <= 5:
        good = [one.sure and one.error <= 0.5 for one in found]
    else:
        good = [one.error <= 1 or not one.sure for one in found]
    share = 100 * sum(good) / len(good)
    return Bar(f"{noise:g} px, {kind}: found", 95.0, share, "%", least=True)


def compare_fits(capture: Capture, arguments: argparse.Namespace) -> tuple[list[Row], list[Bar]]:
    """Fit the capture as it is, and with a view late: mended, and as it came."""
    if capture.points3d is None:
        sys.exit("--fits needs a capture with a ground truth")
    times = np.arange(len(capture)) / arguments.fps
    as_it_is = error_of(capture, capture.keypoints, times, arguments, "auto")
    rows: list[Row] = [{"late by": "in step", "mended": as_it_is, "as it came": as_it_is}]
    worst = 0.0
    for late in LATE_IN_FITS:
        keypoints, _ = harmed(capture, late, 0.0, 0)
        mended = error_of(capture, keypoints, times, arguments, "auto")
        came = error_of(capture, keypoints, times, arguments, "off")
        rows.append({"late by": f"{late:g} frames", "mended": mended, "as it came": came})
        worst = max(worst, mended / as_it_is)
    return rows, [Bar("PA-MPJPE of the mended fit against that in step", 1.1, worst, "x")]


def error_of(
    capture: Capture,
    keypoints: NDArray[np.floating],
    times: Float64,
    arguments: argparse.Namespace,
    synchronise: Automatic,
) -> float:
    """Fit keypoints and return the mean PA-MPJPE over all frames."""
    config = FitConfig(synchronise=synchronise)
    if arguments.steps is not None:
        config = config.model_copy(update={"steps": arguments.steps})
    sizes = None
    if arguments.image_size is not None:
        width, height = map(int, arguments.image_size.split("x"))
        sizes = [(width, height)] * keypoints.shape[1]
    prior = fit(keypoints, config, times=times, image_sizes=sizes)
    read = put_in_step(keypoints.astype(np.float32), None, times, synchronise).keypoints
    assert capture.points3d is not None
    return pa_mpjpe(prior.lift(read).points3d, capture.points3d).mean


if __name__ == "__main__":
    main()
