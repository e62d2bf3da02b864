"""How true structures and cameras are on rigs that nobody chose: hundreds of numbered draws.

    python -m benchmarks.wide_net --help

Each draw (`benchmarks/drawn_captures.py`) is fitted with the default configuration, or with
`--geometry` its cameras are found from keypoints alone, which takes seconds. Constants are set on
the motions of one half; the other shows whether they hold elsewhere. The error is that of
structures aligned frame by frame, never mirrored, on keypoints that two views or more see, beside
that of triangulation with the true cameras. The truth takes no part in any fit.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn_captures import Draw
from benchmarks.draws import add_options, of_draws
from benchmarks.figures import print_table
from benchmarks.motions import HALVES
from benchmarks.net_rows import Row, line, summary
from benchmarks.oracle import by_oracle
from models.calibrating.handedness import certainty
from models.calibrating.keypoint_rig import focal_deviations, geometry_of, start_from_geometry
from models.calibrating.lens_effect import lens_findings
from models.calibrating.pair_lenses import settle_lenses
from models.calibrating.problem import problem_of
from models.capture.metrics import pa_mpjpe, procrustes_by_size
from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from models.findings.finding import Finding
from models.lifting.lift import LiftedFrames
from models.numerics.steps import finished
from models.optics.lenses.projection import Lenses, project
from models.settings.config import FitConfig
from models.settings.lenses import Lens
from models.training.trainer import fit

Float64 = NDArray[np.float64]
DEFAULT = FitConfig()
FEWEST = 4  # keypoints of a frame that two views see, for the frame to count


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    rows = []
    for row in of_draws(_measured, arguments, arguments.half):
        rows.append(row)
        print(line(row), flush=True)
    print_table("Shares", summary(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps([row._asdict() for row in rows]) + "\n")


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description="Measure fits on drawn rigs and motions.")
    add_options(parser)
    parser.add_argument("--half", choices=HALVES, help="draw the motions of this half")
    parser.add_argument("--pairs", action="store_true", help="static pairs alone")
    parser.add_argument("--lenses", type=float, help="give focal lengths so far off, as a share")
    parser.add_argument("--geometry", action="store_true", help="stop before the network")
    parser.add_argument("--oracle", type=Path, help="a module with `find` and `structure`")
    return parser.parse_args()


def _measured(draw: Draw, arguments: argparse.Namespace) -> Row | None:
    if arguments.pairs and (draw.moving or draw.keypoints.shape[1] > 2):
        return None
    found = by_geometry if arguments.geometry else by_fit
    return measure(draw, partial(found, config=_given(draw, arguments)), arguments.oracle)


def _given(draw: Draw, arguments: argparse.Namespace) -> FitConfig:
    """Return the configuration, with focal lengths as a data sheet has them if asked for."""
    if arguments.lenses is None:
        return FitConfig()
    off = np.random.default_rng(draw.number).standard_normal(len(draw.focals))
    focals = draw.focals * np.exp(arguments.lenses * off)
    return FitConfig(lenses=tuple(Lens(focal=focal, sd=arguments.lenses) for focal in focals))


class Answer(NamedTuple):
    """What was made of a draw."""

    points: Float64  # (N, P, 3)
    static: NDArray[np.bool_]  # (K,) which cameras were found to be static
    certainty: float
    rotations: Float64  # (K, 3, 3); NaN of cameras that were not found
    focals: Float64  # (K,) pixels
    focal_sds: Float64  # (K,) of their logs
    reach: float  # as in `Row`
    findings: tuple[Finding, ...]


def by_geometry(draw: Draw, config: FitConfig = DEFAULT) -> Answer:
    """Find cameras without the network, and triangulate with them."""
    weights: Float64 = np.all(np.isfinite(draw.keypoints), -1).astype(np.float64)
    problem = problem_of(np.nan_to_num(draw.keypoints), weights, draw.sizes, config)
    found = finished(geometry_of(problem, declared=False)).rig
    if found is None:
        return _without_cameras(draw, np.full(draw.points3d.shape, np.nan), ())
    problem, found = finished(settle_lenses(problem, found))
    rig, static = found.best.rig, found.static
    started = start_from_geometry(problem, found) if static.all() else None
    findings = () if started is None else finished(lens_findings(problem, *started))
    return Answer(
        found.best.points,
        static,
        certainty([found.log_odds]),
        rig.rotations,
        np.exp(rig.log_focals) * problem.side,
        focal_deviations(problem, found),
        float("nan"),
        findings,
    )


def by_fit(draw: Draw, config: FitConfig = DEFAULT) -> Answer:
    """Fit, and lift the frames of the fit."""
    prior = fit(draw.keypoints, config, times=draw.times, image_sizes=draw.sizes)
    lift = prior.lift(draw.keypoints)
    cameras, points = prior.cameras, lift.points3d.astype(np.float64)
    if cameras is None:
        return _without_cameras(draw, points, prior.findings, _reach(draw, lift))
    return Answer(
        points,
        cameras.static,
        cameras.handedness_certainty,
        np.where(cameras.static[:, None, None], cameras.rotations, np.nan),
        cameras.focals.mean(1),
        cameras.focal_sds / cameras.focals.mean(1),
        _reach(draw, lift),
        prior.findings,
    )


def _without_cameras(
    draw: Draw, points: Float64, findings: tuple[Finding, ...], reach: float = float("nan")
) -> Answer:
    rotations = np.full((draw.keypoints.shape[1], 3, 3), np.nan)
    unknown = rotations[:, 0, 0]
    static = np.zeros(len(rotations), bool)
    return Answer(points, static, 0.0, rotations, unknown, unknown.copy(), reach, findings)


def _reach(draw: Draw, lift: LiftedFrames) -> float:
    """Largest distance of a reprojection from the centre of its image, in longer sides of it."""
    furthest = 0.0
    for k in range(draw.keypoints.shape[1]):
        there = lift.camera_models[:, k] > 0  # perspective
        if not there.any():
            continue
        rotations, shifts = lift.rotations[there, k], lift.translations[there, k, None]
        held = (lift.points3d[there] @ rotations.mT + shifts).astype(np.float64)
        lenses = Lenses(
            lift.focals[there, k].astype(np.float64),
            lift.principal_points[there, k].astype(np.float64),
            lift.distortions[there, k].astype(np.float64),
            lift.camera_models[there, k] - np.int8(1),
        )
        away = np.abs(project(held, lenses) - draw.images[k] / 2) / draw.images[k].max()
        furthest = max(furthest, float(np.nanmax(away, initial=0)))
    return furthest


def measure(draw: Draw, found: Callable[[Draw], Answer], oracle: Path | None) -> Row:
    """Hold an answer against the truth and against triangulation with the true cameras."""
    started = time.perf_counter()
    answer = found(draw)
    seconds = time.perf_counter() - started
    asked = draw.seen_twice & np.isfinite(draw.points3d).all(-1)
    asked &= asked.sum(1, keepdims=True) >= FEWEST
    error = _error(draw, answer.points, asked)
    reflected = _error(draw, answer.points * [1, 1, -1], asked)
    bound = _error(draw, triangulated(draw), asked)
    once = np.isfinite(draw.keypoints).all(-1).sum(1) == 1
    logs = np.abs(np.log(answer.focals / draw.focals))
    return Row(
        draw.number,
        draw.words,
        error,
        bound,
        np.nan if oracle is None else _error(draw, by_oracle(draw, oracle), asked),
        bool(reflected < error),
        answer.certainty,
        tuple(draw.static.tolist()),
        tuple(answer.static.tolist()),
        [float(score) for score in logs / answer.focal_sds if np.isfinite(score)],
        float(np.nanmax(logs, initial=0)),
        _turn(draw, answer.rotations),
        _inferred(draw, answer.points, asked, once),
        answer.reach,
        tuple(sorted({finding.code for finding in answer.findings})),
        seconds,
    )


def triangulated(draw: Draw) -> Float64:
    """Points (N, P, 3) of robust triangulation with the true cameras; NaN where one view sees."""
    side = 1000.0  # only a unit
    points = np.full(draw.points3d.shape, np.nan)
    # As pixels of cameras whose lenses stay: a lens that changes moves and scales pixels alone.
    ahead = (draw.keypoints - draw.frame_centres[..., None, :]) / draw.frame_focals[..., None, :]
    pixels = draw.focals[:, None, None] * ahead / side
    poses = draw.rotations, draw.translations
    still = all(np.array_equal(pose, np.broadcast_to(pose[0], pose.shape)) for pose in poses)
    for frames in [list(range(len(points)))] if still else [[n] for n in range(len(points))]:
        first = frames[0]
        rig = StaticCameras(
            np.log(draw.focals / side),
            np.zeros(draw.centres.shape),
            np.stack((draw.radial, np.zeros(len(draw.radial))), 1),
            draw.rotations[first],
            draw.translations[first],
        )
        views, count = pixels.shape[1], pixels.shape[2]
        images = pixels[frames].transpose(1, 3, 0, 2).reshape(views, 2, -1)
        weights = np.isfinite(images).all(1).astype(float)
        twice = weights.sum(0) > 1
        seen = SeenPoints(np.nan_to_num(images[..., twice]), weights[:, twice])
        noise = np.full(views, max(draw.noise, 1e-3 * side / 10) / side)
        of_frames = np.full((len(frames) * count, 3), np.nan)
        of_frames[twice] = robust_points(rig, seen, noise).T
        points[frames] = of_frames.reshape(len(frames), count, 3)
    return points


def _error(draw: Draw, points: Float64, asked: NDArray[np.bool_]) -> float:
    """Mean distance after alignment over the subject's height; keypoints `asked` (N, P)."""
    truth = np.where(asked[..., None], draw.points3d, np.nan)
    return pa_mpjpe(points, truth, reflection="never").mean / draw.height


def _inferred(
    draw: Draw, points: Float64, asked: NDArray[np.bool_], once: NDArray[np.bool_]
) -> tuple[float, float]:
    """Median and 95th percentile of the errors where one view sees, in heights of the subject.

    Each frame is aligned by the keypoints `asked` (N, P); those seen `once` (N, P) are measured.
    """
    moved = procrustes_by_size(points, np.where(asked[..., None], draw.points3d, np.nan))
    errors = np.linalg.norm(moved - draw.points3d, axis=-1)[once & asked.any(1, keepdims=True)]
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return float("nan"), float("nan")
    median, most = np.quantile(errors / draw.height, (0.5, 0.95))
    return float(median), float(most)


def _turn(draw: Draw, rotations: Float64) -> float:
    """Largest error in degrees of a rotation between two static cameras that were found so."""
    known = np.flatnonzero(np.isfinite(rotations).all((1, 2)) & draw.static)
    if len(known) < 2:
        return float("nan")
    ours = rotations[known][:, None] @ rotations[known].mT
    true = draw.rotations[0, known][:, None] @ draw.rotations[0, known].mT
    cosines = (np.trace(ours @ true.mT, axis1=-2, axis2=-1) - 1) / 2
    return float(np.degrees(np.arccos(cosines.clip(-1, 1)).max()))


if __name__ == "__main__":
    main()
