"""How well images with planted errors are found, and how true the accepted labels are.

    python -m benchmarks.labels CAPTURE.npz ... [--seeds 3] [--bursts 10] [--pixels 40] [--noise 0]
                                [--steps 200] [--frames 400] [--json FILE]

Noise is added to the capture's keypoints. Then bursts of five frames are planted, in each of which
a view shows one keypoint so many pixels off, and a view that shows nobody for eight frames. The
capture is fitted, and its images are ranked. The capture's own keypoints are what labels are
compared with; no other truth takes part.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.captures import Capture, CaptureError, read_capture
from benchmarks.figures import Results, Row, command
from models.labelling.accepted import Accepted, Sizes, accept
from models.labelling.evidence import Evidence, weigh
from models.labelling.filmed import Filmed, as_filmed
from models.labelling.worth import Ranking, rank
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.trainer import fit
from worker.rooms import Room

Float64 = NDArray[np.float64]

BURST, BLIND = 5, 8  # frames
LISTED = 50


class Planted(NamedTuple):
    """Keypoints with errors (N, K, P, 2), and where these are."""

    keypoints: Float64
    bursts: list[tuple[int, int, int]]  # first frame, view, keypoint
    blind: tuple[int, int]  # first frame, view


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    use_threads(1)  # as in the service
    rows: list[Row] = []
    for file in arguments.captures:
        try:
            capture = read_capture(file).frames(slice(arguments.frames))
        except CaptureError as error:
            sys.exit(f"{file.name}: {error}")
        rows += [measured(file.stem, capture, seed, arguments) for seed in range(arguments.seeds)]
    Results("labels", vars(arguments), {"Labels": rows}).publish(arguments.json)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = command("Measure how planted errors are ranked, and how true labels are.")
    parser.add_argument("captures", type=Path, nargs="+", help=".npz")
    parser.add_argument("--seeds", type=int, default=3, help="of errors: %(default)s")
    parser.add_argument("--bursts", type=int, default=10, help="planted: %(default)s")
    parser.add_argument("--pixels", type=float, default=40.0, help="of an error: %(default)s")
    parser.add_argument("--noise", type=float, default=0.0, help="pixels; default: %(default)s")
    parser.add_argument("--steps", type=int, default=200, help="of the fits: %(default)s")
    parser.add_argument("--frames", type=int, default=400, help="the first so many: %(default)s")
    return parser.parse_args()


def planted(capture: Capture, seed: int, arguments: argparse.Namespace) -> Planted:
    """Return the capture with noise and errors."""
    rng = np.random.default_rng(seed)
    keypoints = capture.keypoints.astype(np.float64)
    keypoints += arguments.noise * rng.standard_normal(keypoints.shape)
    frames, views = keypoints.shape[:2]
    seen = np.argwhere(np.isfinite(keypoints[: frames - BURST]).all(-1))
    bursts = []
    for frame, view, keypoint in rng.choice(seen, arguments.bursts, replace=False).tolist():
        angle = rng.uniform(0, 2 * np.pi)
        off = arguments.pixels * np.array([np.cos(angle), np.sin(angle)])
        keypoints[frame : frame + BURST, view, keypoint] += off
        bursts.append((frame, view, keypoint))
    blind = int(rng.integers(frames - BLIND)), int(rng.integers(views))
    keypoints[blind[0] : blind[0] + BLIND, blind[1]] = np.nan
    return Planted(keypoints, bursts, blind)


def measured(name: str, capture: Capture, seed: int, arguments: argparse.Namespace) -> Row:
    """Plant errors, fit, rank and accept; return the figures."""
    errors = planted(capture, seed, arguments)
    sizes = sizes_of(capture)
    film, evidence = filmed(errors.keypoints, capture, arguments.steps)
    ranking = rank(film, evidence, sizes, most=LISTED)
    row: Row = {"capture": name, "seed": seed, "bursts": len(errors.bursts)}
    row |= found_in(ranking, errors)
    row["detected, px"] = distance(errors.keypoints, capture)
    for source in ("keypoints", "reprojections"):
        accepted = accept(film, evidence, sizes, source)
        row[f"{source}, px"] = distance(accepted.keypoints, capture)
        row[f"{source}, share"] = share(accepted, capture)
    return row


def sizes_of(capture: Capture) -> Sizes:
    """Return the image sizes of the views, None where the capture has none."""
    if capture.image_sizes is None:
        return [None] * capture.keypoints.shape[1]
    return [(int(width), int(height)) for width, height in capture.image_sizes]


def filmed(keypoints: Float64, capture: Capture, steps: int) -> tuple[Filmed, Evidence]:
    """Fit keypoints, and return what labels are made of."""
    pixels = keypoints.astype(np.float32)
    config = FitConfig(steps=steps, seed=1)
    prior = fit(pixels, config, confidence=capture.confidence)
    found = prior.lift(pixels, confidence=capture.confidence).arrays
    cameras, placed = prior.cameras, None
    if cameras is not None and cameras.static.any():
        room = Room(cameras.rotations, cameras.translations)
        placed = room.place_arrays(found)["points3d"]
    film = as_filmed(pixels, capture.confidence, found, None, cameras, placed)
    return film, weigh(film)


def found_in(ranking: Ranking, errors: Planted) -> Row:
    """Return what of the planted errors is listed, and how far up."""
    start, view = errors.blind
    hits: list[set[int]] = []
    blind = None
    for place, image in enumerate(ranking.images, start=1):
        about = {keypoint for reason in image.reasons for keypoint in reason.keypoints}
        hits.append(
            {
                number
                for number, (first, seen_by, keypoint) in enumerate(errors.bursts)
                if image.view == seen_by
                and first <= image.frame < first + BURST
                and keypoint in about
            }
        )
        if image.view == view and start <= image.frame < start + BLIND and blind is None:
            blind = place
    top = hits[: len(errors.bursts)]
    return {
        "found": len(set().union(*hits)),
        f"of the first {len(errors.bursts)}": sum(map(bool, top)),
        "place of the blind view": blind,
        "listed": len(ranking.images),
        "candidates": ranking.candidates,
    }


def distance(keypoints: Float64, capture: Capture) -> float:
    """Return the mean distance from the capture's own keypoints, in pixels."""
    return float(np.nanmean(np.linalg.norm(keypoints - capture.keypoints, axis=-1)))


def share(accepted: Accepted, capture: Capture) -> float:
    """Return the share of the capture's keypoints that have a label."""
    seen = np.isfinite(capture.keypoints).all(-1)
    return float((accepted.weights > 0)[seen].mean())


if __name__ == "__main__":
    main()
