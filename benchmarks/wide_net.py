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
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn_captures import Draw
from benchmarks.draws import add_options, of_draws
from benchmarks.figures import print_table
from benchmarks.motions import HALVES
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
SLACK = 0.001  # of the subject's height that is granted beyond a ratio
ABOUT_CAMERAS = (  # findings that warn of the cameras
    "cameras_not_found",
    "focal_not_observable",
    "handedness_not_observable",
    "lenses_extreme",
    "lenses_limit_accuracy",
    "views_opposite",
)


class Row(NamedTuple):
    """What was found of one draw."""

    number: int
    words: str
    error: float  # of the answer, in units of the subject's height
    bound: float  # the same of triangulation with the true cameras
    oracle: float  # the same of the oracle
    mirrored: bool  # whether the mirror image is nearer to the truth
    certainty: float  # of the handedness
    moving: bool  # as drawn
    called_moving: bool
    focal_scores: list[float]  # errors of log focal lengths over their standard deviations
    focal_error: float  # largest error of a log focal length
    turn: float  # degrees, largest error of a rotation between two cameras
    inferred: tuple[float, float]  # median and 95th percentile where one view sees, in heights
    reach: float  # longer sides of the image, largest distance of a reprojection from its centre
    findings: tuple[str, ...]
    seconds: float

    @property
    def ratio(self) -> float:
        """The error over what triangulation with the true cameras has, less the slack."""
        return max(self.error - SLACK, 0.0) / max(self.bound, 1e-9)


def main() -> None:
    """Run the command line."""
    arguments = parse_arguments()
    rows = []
    for row in of_draws(_measured, arguments, arguments.half):
        rows.append(row)
        print(_line(row), flush=True)
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
    static: bool  # whether all cameras were found to be static
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
    rig, static = found.best.rig, bool(found.static.all())
    started = start_from_geometry(problem, found) if static else None
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
    prior = fit(draw.keypoints, config, image_sizes=draw.sizes)
    lift = prior.lift(draw.keypoints)
    cameras, points = prior.cameras, lift.points3d.astype(np.float64)
    if cameras is None:
        return _without_cameras(draw, points, prior.findings, _reach(draw, lift))
    return Answer(
        points,
        bool(cameras.static.all()),
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
    return Answer(points, False, 0.0, rotations, unknown, unknown.copy(), reach, findings)


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
        away = np.abs(project(held, lenses) - draw.centres[k]) / (2 * draw.centres[k].max())
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
        draw.moving,
        not answer.static,
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
    for frames in [range(len(points))] if not draw.moving else [[n] for n in range(len(points))]:
        first = frames[0]
        rig = StaticCameras(
            np.log(draw.focals / side),
            draw.centres / side,
            np.stack((draw.radial, np.zeros(len(draw.radial))), 1),
            draw.rotations[first],
            draw.translations[first],
        )
        pixels = draw.keypoints[list(frames)]
        views, count = pixels.shape[1], pixels.shape[2]
        images = pixels.transpose(1, 3, 0, 2).reshape(views, 2, -1) / side
        weights = np.isfinite(images).all(1).astype(float)
        twice = weights.sum(0) > 1
        seen = SeenPoints(np.nan_to_num(images[..., twice]), weights[:, twice])
        noise = np.full(views, max(draw.noise, 1e-3 * side / 10) / side)
        of_frames = np.full((len(pixels) * count, 3), np.nan)
        of_frames[twice] = robust_points(rig, seen, noise).T
        points[list(frames)] = of_frames.reshape(len(pixels), count, 3)
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
    """Largest error in degrees of a rotation between two cameras that were found to be static."""
    known = np.flatnonzero(np.isfinite(rotations).all((1, 2)))
    if len(known) < 2 or draw.moving:
        return float("nan")
    ours = rotations[known][:, None] @ rotations[known].mT
    true = draw.rotations[0, known][:, None] @ draw.rotations[0, known].mT
    cosines = (np.trace(ours @ true.mT, axis1=-2, axis2=-1) - 1) / 2
    return float(np.degrees(np.arccos(cosines.clip(-1, 1)).max()))


def summary(rows: list[Row]) -> list[dict[str, Any]]:
    """Shares of the draws that hold each bar, and the worst of them."""
    static = [row for row in rows if not row.moving]
    kinds = {
        "three views or more": [row for row in static if " 2 views" not in row.words],
        "pairs": [row for row in static if " 2 views" in row.words],
    }
    table: list[dict[str, Any]] = []
    for (name, some), (limit, far) in zip(kinds.items(), ((1.1, 2.0), (1.5, 3.0)), strict=True):
        unsaid = [row for row in some if not set(row.findings) & set(ABOUT_CAMERAS)]
        near = [row for row in some if row.ratio <= limit]
        not_far = [row for row in unsaid if row.ratio <= far]
        table += [
            _share(f"{name}: within {limit} x", some, near),
            _share(f"{name}: not beyond {far} x unsaid", unsaid, not_far),
            _share(f"{name}: called static", some, [row for row in some if not row.called_moving]),
        ]
        scores = np.array([score for row in some for score in row.focal_scores])
        if len(scores):
            worst = max(some, key=lambda row: max(row.focal_scores, default=0))
            table.append(
                {
                    "what": f"{name}: focal lengths, RMS of z",
                    "share": f"{np.sqrt(np.mean(scores**2)):.2f}",
                    "worst": f"largest {scores.max():.1f} ({worst.number})",
                }
            )
    moving = [row for row in rows if row.moving]
    sure = [row for row in rows if row.certainty > 0.99]
    table += [
        _share("moving: called moving", moving, [row for row in moving if row.called_moving]),
        _share(
            "certain of the hand: not mirrored", sure, [row for row in sure if not row.mirrored]
        ),
    ]
    inferred = [row for row in rows if np.isfinite(row.inferred[0])]
    table += [
        _share(
            "seen by one view: median within 25 %, 95th percentile within 80 %",
            inferred,
            [row for row in inferred if row.inferred[0] <= 0.25 and row.inferred[1] <= 0.8],
        ),
        _share("reprojections within 20 image sides", rows, [r for r in rows if not r.reach > 20]),
    ]
    seconds = [row.seconds for row in rows]
    if seconds:
        median, most = np.median(seconds), max(seconds)
        table.append({"what": "seconds", "share": f"{median:.1f}", "worst": f"most {most:.1f}"})
    return table


def _share(what: str, rows: list[Row], good: list[Row]) -> dict[str, Any]:
    """Return the share of rows that are good, and the worst of the others."""
    bad = sorted((row for row in rows if row not in good), key=lambda row: -row.ratio)
    worst = ", ".join(f"{row.number} ({row.ratio:.2g})" for row in bad[:12])
    return {"what": what, "share": f"{len(good)} of {len(rows)}", "worst": worst}


def _line(row: Row) -> str:
    def figures() -> Iterator[str]:
        yield f"{row.number} | x{row.ratio:.2f}"
        yield f"error {100 * row.error:.3g} % (true cameras {100 * row.bound:.3g})"
        if np.isfinite(row.oracle):
            yield f"oracle x{max(row.oracle - SLACK, 0) / max(row.bound, 1e-9):.2f}"
        yield f"focal {100 * row.focal_error:.2g} % z {max(row.focal_scores, default=0):.1f}"
        yield f"turn {row.turn:.2g} deg"
        yield f"{'MIRRORED ' if row.mirrored else ''}sure {row.certainty:.3f}"
        if np.isfinite(row.inferred[0]):
            yield f"one view {100 * row.inferred[0]:.2g}, {100 * row.inferred[1]:.2g} %"
        if row.reach > 1:
            yield f"reach {row.reach:.2g}"
        if row.moving != row.called_moving:
            yield "CALLED MOVING" if row.called_moving else "CALLED STATIC"
        yield f"{row.seconds:.1f} s"
        yield row.words
        yield ", ".join(row.findings)

    return " | ".join(figures())


if __name__ == "__main__":
    main()
