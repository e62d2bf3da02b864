"""The accuracy of structures on any capture with a ground truth: the paper's tables and more.

    python benchmarks/fidelity.py [CAPTURE.npz] [--full] [--seeds 0 1 2] [--only views noise ...]
                                  [--image-size WxH] [--every N] [--fps F] [--prior NAME]
                                  [--json FILE] [--output DIR]

README.md describes the cases. No fit uses the truth.
"""

import argparse
import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench import PCK_MM, Bench
from benchmarks.captures import fields_beside
from benchmarks.cases import CASES
from benchmarks.harms import keypoint_names, partners_by_name
from benchmarks.report import TRNG, Report, draw, markdown
from benchmarks.rig import find_rig
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.settings.priors import PRIOR_SETTINGS

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "examples"))  # where `capture` lies
from capture import CaptureError, read_capture  # noqa: E402

MILLIMETRES = {"m": 1000.0, "cm": 10.0, "mm": 1.0}


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)  # as in the service
    bench = prepare(arguments)
    for seed in arguments.seeds:
        for name, measure in CASES.items():
            if name in arguments.only:
                measure(bench, seed)
        bench.fits.clear()
    figures = about(arguments, bench) | bench.report.as_json()
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "tables.md").write_text(markdown(figures["medians"]))
        for path in draw(bench.report, figures["capture"], arguments.output):
            print(f"drawn: {path.name}")
    line = json.dumps(figures)
    file = arguments.json or (arguments.output and arguments.output / "fidelity.json")
    if file:
        file.write_text(line + "\n")
    if len(arguments.seeds) > 1:
        print("\nMedians\n\n" + markdown(figures["medians"]))


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Measure the fidelity on a capture with truth.")
    example = ROOT / "examples" / "three_actors.npz"
    parser.add_argument("capture", type=Path, nargs="?", default=example, help=".npz with points3d")
    parser.add_argument("--full", action="store_true", help="everything, not the quick set")
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="default: 0")
    parser.add_argument("--pair", type=int, nargs=2, default=(0, 1), help="views; default: 0 1")
    parser.add_argument("--unit", choices=list(MILLIMETRES), default="m", help="of points3d")
    parser.add_argument("--image-size", type=_size, help="WxH of every view, if the file has none")
    parser.add_argument("--every", type=_count, default=1, metavar="N", help="use every Nth frame")
    parser.add_argument(
        "--fps", type=float, help="of frames that follow each other: given to the fit as well"
    )
    parser.add_argument("--steps", type=int, default=None, help="of a fit; fewer for a try")
    parser.add_argument(
        "--prior", choices=list(PRIOR_SETTINGS), default="hierarchical", help="to fit"
    )
    parser.add_argument("--json", type=Path, help="write the results to this file")
    parser.add_argument("--output", type=Path, help="folder for plots, tables and fidelity.json")
    return parser.parse_args()


def prepare(arguments: argparse.Namespace) -> Bench:
    """Read the capture, estimate its cameras from the truth, and print both."""
    try:
        capture = read_capture(arguments.capture).frames(slice(None, None, arguments.every))
    except CaptureError as error:
        sys.exit(f"{arguments.capture.name}: {error}")
    if capture.points3d is None:
        sys.exit(f"{arguments.capture.name} has no points3d: nothing to measure against")
    count = capture.keypoints.shape[1]
    if count < 2 or not all(0 <= view < count for view in arguments.pair):
        sys.exit(f"--pair {arguments.pair}: the capture has {count} views; two are needed")
    sizes = None
    if capture.image_sizes is not None:
        sizes = [(int(width), int(height)) for width, height in capture.image_sizes]
    elif arguments.image_size is not None:
        sizes = [arguments.image_size] * count
    rig = find_rig(capture.keypoints, capture.points3d)
    frames, views, points, _ = capture.keypoints.shape
    say = f"{arguments.capture.stem}: {frames} frames, {views} views, {points} keypoints; "
    if rig is None:
        print(say + f"not all cameras are static, so there is no {TRNG}")
    else:
        off = ", ".join(f"{residual:.2f}" for residual in rig.residuals)
        print(say + f"cameras for {TRNG} found from the truth, median residual {off} px")
    changes = {"prior": arguments.prior}
    if arguments.steps is not None:
        changes["steps"] = arguments.steps
    return Bench(
        keypoints=capture.keypoints,
        given_confidence=capture.confidence,
        truth=capture.points3d,
        sizes=sizes,
        edges=fields_beside(arguments.capture).get("edges", capture.edges),
        config=FitConfig.model_validate(changes),
        metre=1000 / MILLIMETRES[arguments.unit],
        pair=tuple(arguments.pair),
        full=arguments.full,
        report=Report(say=lambda line: print(line, flush=True)),
        rig=rig,
        partners=partners_by_name(keypoint_names(arguments.capture) or [""] * points),
        times=None
        if arguments.fps is None
        else np.arange(frames) * arguments.every / arguments.fps,
    )


def about(arguments: argparse.Namespace, bench: Bench) -> dict[str, Any]:
    """Return what was measured, and with what."""
    packages = ("fewview-server", "numpy", "torch")
    frames, views, points, _ = bench.keypoints.shape
    return {
        "capture": arguments.capture.stem,
        "frames": frames,
        "views": views,
        "keypoints": points,
        "image_sizes": bench.sizes,
        "every": arguments.every,
        "fps": arguments.fps,
        "set": "full" if bench.full else "quick",
        "cases": arguments.only,
        "pair": bench.pair,
        "seeds": arguments.seeds,
        "pck_mm": PCK_MM,
        "config": bench.config.model_dump(mode="json"),
        "calibration_residuals_px": None if bench.rig is None else bench.rig.residuals.tolist(),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in packages},
    }


def _count(text: str) -> int:
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


if __name__ == "__main__":
    main()
