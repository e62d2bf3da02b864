"""How well cameras are found, on captures with a truth and on drawn rigs, harmed in several ways.

    python -m benchmarks.cameras CAPTURE.npz ... [--moving NAME ...] [--only clean 15px ...]
                                 [--rigs N] [--steps N] [--json FILE]

Each capture is fitted shortly, with and without its image sizes; the figures are those of the
cameras that the fit found. Next to CAPTURE.npz there may be a CAPTURE.json with `image_sizes` and
with `cameras` (`K` and `R` of each); without these, cameras are found from the truth. The truth
takes part in no fit. With `--rigs N`, so many rigs of 3 to 6 unlike lenses are drawn, too.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import Capture, fields_beside, read_capture
from benchmarks.deviations import Kind, draw, found_by
from benchmarks.rig import add_noise, find_lenses, hide
from models.calibrating.result import CameraReport, camera_report
from models.capture.metrics import pa_mpjpe
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]

STEPS = 900  # of a fit: enough for a network to start from
OUTLIERS, GAPS = 0.1, 0.3  # shares of the keypoints
HARMS = ("clean", "5px", "15px", "outliers", "gaps")
DRAWN_FRAMES = 100


class Truth(NamedTuple):
    """The true static cameras."""

    rotations: Float64  # (K, 3, 3)
    focals: Float64  # (K,) pixels


class Row(NamedTuple):
    """What was found of one case."""

    case: str
    arrangement: str
    expected: str
    focal: float  # per cent, largest error
    rotation: float  # degrees, mean error between two cameras
    hand: str
    certainty: float
    error: float  # PA-MPJPE in the unit of the truth, never mirrored
    noise: float  # pixels
    seconds: float


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)  # as in the service
    rows = []
    print("case | arrangement | focal % | rotation deg | hand | sure | error | noise px | s")
    for path in arguments.captures:
        for row in of_capture(path, arguments):
            rows.append(row)
            say(row)
    for row in of_drawn_rigs(arguments.rigs):
        rows.append(row)
        say(row)
    judged = bars(rows)
    for name, reached in judged.items():
        print(f"{name}: {reached}")
    if arguments.json:
        figures = {"rows": [row._asdict() for row in rows], "bars": judged}
        arguments.json.write_text(json.dumps(figures) + "\n")


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Measure how well cameras are found.")
    parser.add_argument("captures", type=Path, nargs="*", help=".npz with points3d")
    parser.add_argument("--only", nargs="+", choices=HARMS, default=list(HARMS))
    parser.add_argument("--sizes", choices=("known", "unknown", "both"), default="both")
    parser.add_argument("--image-size", help="WxH of every view of captures without sizes")
    parser.add_argument("--moving", nargs="+", default=[], help="names of captures that move")
    parser.add_argument("--rigs", type=int, default=0, help="drawn rigs of unlike lenses")
    parser.add_argument("--steps", type=int, default=STEPS, help="of a fit; default: %(default)s")
    parser.add_argument("--json", type=Path, help="write the results to this file")
    return parser.parse_args()


def of_capture(path: Path, arguments: argparse.Namespace) -> Iterator[Row]:
    """Fit a capture in every way that is asked for."""
    capture = read_capture(path)
    if capture.points3d is None:
        raise SystemExit(f"{path.name} has no points3d: nothing to measure against")
    fields = fields_beside(path)
    moves = path.stem in arguments.moving
    truth = None if moves else true_cameras(capture, fields)
    sizes = image_sizes(capture, fields, arguments.image_size)
    for harm in arguments.only:
        keypoints = harmed(capture.keypoints, harm)
        for given in (True, False):
            if arguments.sizes == ("unknown" if given else "known") or (given and sizes is None):
                continue
            started = time.process_time()
            prior = fit(
                keypoints,
                FitConfig(steps=arguments.steps),
                confidence=capture.confidence,
                image_sizes=sizes if given else None,
            )
            seconds = time.process_time() - started
            case = f"{path.stem}, {harm}, {'sizes' if given else 'no sizes'}"
            if prior.cameras is None:
                raise SystemExit(f"{case}: no cameras were found")
            points = prior.lift(keypoints, confidence=capture.confidence).points3d
            row = compare(case, prior.cameras, truth, points.astype(np.float64), capture.points3d)
            yield row._replace(expected="moving" if moves else "static", seconds=seconds)


def of_drawn_rigs(count: int) -> Iterator[Row]:
    """Draw rigs of 3 to 6 unlike lenses and find them from keypoints with 1.5 px of noise."""
    for seed in range(count):
        for sized in (True, False):
            kind = Kind(3 + seed % 4, alike=False, sized=sized)
            drawn = draw(kind, seed, frames=DRAWN_FRAMES)
            started = time.process_time()
            found, scene = found_by(drawn, sized=sized)
            seconds = time.process_time() - started
            focals = np.array([lens.focal for lens in drawn.lenses])
            truth = Truth(drawn.rotations[0], focals)
            case = f"drawn {seed}: {kind}"
            row = compare(case, camera_report(found), truth, scene.points, drawn.points3d)
            yield row._replace(seconds=seconds)


def compare(
    case: str, found: CameraReport, truth: Truth | None, points: Float64, true_points: Any
) -> Row:
    """Hold cameras and structures against the truth."""
    focal = rotation = np.nan
    if truth is not None:
        focal = float(100 * np.abs(found.focals.mean(1) / truth.focals - 1).max())
        static = np.flatnonzero(found.static)
        if len(static) > 1:
            rotation = rotation_error(found.rotations[static], truth.rotations[static])
    errors = [
        pa_mpjpe(image, true_points, reflection="never").mean
        for image in (points, points * [1, 1, -1])
    ]
    return Row(
        case,
        found.arrangement,
        "static",
        focal,
        rotation,
        "right" if errors[0] < errors[1] else "wrong",
        found.handedness_certainty,
        errors[0],
        found.noise,
        0.0,
    )


def rotation_error(found: Float64, truth: Float64) -> float:
    """Mean error in degrees of the rotation (n, 3, 3) from one camera to another."""
    first, second = np.triu_indices(len(found), 1)
    ours = found[second] @ found[first].mT
    theirs = truth[second] @ truth[first].mT
    cosines = (np.trace(ours @ theirs.mT, axis1=1, axis2=2) - 1) / 2
    return float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean())


def true_cameras(capture: Capture, fields: dict[str, Any]) -> Truth | None:
    """Return cameras from a file, or estimated from the truth; None where that is not possible."""
    if fields.get("cameras"):
        matrices = np.array([camera["K"] for camera in fields["cameras"]])
        focals = (matrices[:, 0, 0] + matrices[:, 1, 1]) / 2
        return Truth(np.array([camera["R"] for camera in fields["cameras"]]), focals)
    found = find_lenses(capture.keypoints, np.asarray(capture.points3d))
    return None if found is None else Truth(found.rotations, found.focals)


def image_sizes(
    capture: Capture, fields: dict[str, Any], option: str | None
) -> list[tuple[int, int]] | None:
    """Return sizes of the images from the capture, the file beside it or the option, if any."""
    views = capture.keypoints.shape[1]
    given = capture.image_sizes if capture.image_sizes is not None else fields.get("image_sizes")
    if given is None and option is not None:
        width, _, height = option.partition("x")
        given = [(int(width), int(height))] * views
    return None if given is None else [(int(width), int(height)) for width, height in given]


def harmed(keypoints: Any, harm: str, seed: int = 0) -> Float64:
    """Return keypoints with noise, outliers (about their view's middle) or gaps."""
    pixels = np.array(keypoints, np.float64)
    rng = np.random.default_rng(seed)
    if harm.endswith("px"):
        return add_noise(pixels, float(harm.removesuffix("px")), seed)
    if harm == "gaps":
        return hide(pixels, GAPS, seed)
    if harm == "outliers":
        middle = np.nanmean(pixels, 2, keepdims=True)
        spread = np.nanstd(pixels, (0, 2), keepdims=True)
        stray = middle + spread * rng.standard_normal(pixels.shape)
        return np.where((rng.random(pixels.shape[:3]) < OUTLIERS)[..., None], stray, pixels)
    return pixels


def say(row: Row) -> None:
    """Print a row."""
    figures = f"{row.focal:.1f} | {row.rotation:.2f} | {row.hand} | {row.certainty:.3f}"
    print(
        f"{row.case} | {row.arrangement} | {figures} | {row.error:.4g} | {row.noise:.3g}"
        f" | {row.seconds:.0f}",
        flush=True,
    )


def bars(rows: list[Row]) -> dict[str, str]:
    """Count how many cases reach each bar."""

    def share(good: list[bool]) -> str:
        return f"{sum(good)} of {len(good)}"

    drawn = [row for row in rows if row.case.startswith("drawn")]
    given = [row for row in drawn if "no sizes" not in row.case]
    unknown = [row for row in drawn if "no sizes" in row.case]
    return {
        "static or moving as they are": share([row.arrangement == row.expected for row in rows]),
        "the right handedness, or certainty below 0.99": share(
            [row.hand == "right" or row.certainty < 0.99 for row in rows]
        ),
        "drawn rigs, sizes given: every focal length within 2 %": share(
            [row.focal <= 2 for row in given]
        ),
        "drawn rigs, no sizes: every focal length within 6 %": share(
            [row.focal <= 6 for row in unknown]
        ),
    }


if __name__ == "__main__":
    main()
