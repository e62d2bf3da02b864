"""Errors in the room: structures and cameras under one similarity for the whole capture.

    python -m benchmarks.world CAPTURE.npz --image-size 1000x1000 --noise 0 5 --seeds 0 1 2

PA-MPJPE aligns every frame alone, and so forgives cameras that place and turn each frame otherwise.
Here the answer of a fit, keypoints and cameras in the frame of reference of the room, is brought
onto the truth once, by the similarity that least squares gives of all keypoints (Umeyama, 1991).
Then: W-MPJPE, the mean distance of keypoints; of cameras the mean distance of their centres and the
mean angle of their rotations, and without any alignment the mean error of the horizontal field of
view. The noise is that of a detector: `--noise` pixels with the tails of Student's t of 4 degrees
of freedom, and of it the share `--repeated` in offsets that a keypoint has in all frames of a view.

`--angles FILE` writes true and estimated joint angles of named knees and elbows, as
`poseaudit paired --table FILE --big-error 5` reads them. No fit uses the truth.
"""

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.captures import fields_beside, read_capture
from benchmarks.figures import print_table
from benchmarks.rig import TrueLenses, find_lenses
from models.capture.metrics import pa_mpjpe
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.numerics.rotations import nearest_rotations
from models.numerics.threads import use_threads
from models.settings.config import FitConfig
from models.training.trainer import fit

Float64 = NDArray[np.float64]
FREEDOM = 4  # of the tails
REPEATED = 0.5  # share of the noise
MILLIMETRES = 1000.0
JOINTS = {  # the angle at the second keypoint
    "knee": ("hip", "knee", "ankle"),
    "elbow": ("shoulder", "elbow", "wrist"),
}


class Similarity(NamedTuple):
    """x becomes scale * rotation @ x + translation."""

    scale: float
    rotation: Float64  # (3, 3)
    translation: Float64  # (3,)

    def of(self, points: Float64) -> Float64:
        """Return points (..., 3) after it."""
        moved: Float64 = self.scale * points @ self.rotation.T + self.translation
        return moved


class WorldErrors(NamedTuple):
    """Errors in the room; distances in millimetres, angles in degrees."""

    w_mpjpe: float
    pa_mpjpe: float
    centres: float  # mean distance of cameras' centres
    turn: float  # mean angle of cameras' rotations
    view: float  # mean error of the horizontal field of view


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure errors in the room, with one alignment.")
    parser.add_argument("capture", type=Path, help=".npz with points3d in metres")
    parser.add_argument("--image-size", default="1000x1000", help="WxH of every view")
    parser.add_argument("--noise", type=float, nargs="+", default=[0, 5], help="pixels")
    parser.add_argument("--repeated", type=float, default=REPEATED, help="share of the noise")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--views", type=int, nargs="+", help="these alone")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="use every Nth frame")
    parser.add_argument("--angles", type=Path, help="write joint angles to this CSV file")
    arguments = parser.parse_args()
    use_threads(1)
    print_table("Errors in the room: mm and degrees, mean (sd) over seeds", list(_rows(arguments)))


def _rows(arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    capture = read_capture(arguments.capture).frames(slice(None, None, arguments.every))
    if capture.points3d is None:
        raise SystemExit(f"{arguments.capture.name} has no points3d: nothing to measure against")
    truth = capture.points3d.astype(np.float64)
    cameras = find_lenses(capture.keypoints, truth)
    if cameras is None:
        raise SystemExit(f"{arguments.capture.name}: not all cameras are static")
    views = arguments.views or list(range(capture.keypoints.shape[1]))
    cameras = TrueLenses(*(part[views] for part in cameras))
    width, height = map(int, arguments.image_size.split("x"))
    beside = fields_beside(arguments.capture)
    for noise in arguments.noise:
        found = []
        for seed in arguments.seeds:
            keypoints = detected(capture.keypoints[:, views], noise, seed, arguments.repeated)
            prior = fit(
                keypoints,
                FitConfig(seed=seed),
                image_sizes=[(width, height)] * len(views),
                edges=beside.get("edges"),
            )
            lift = prior.lift(keypoints)
            found.append(world_errors(prior, lift, truth, cameras, width))
            if arguments.angles is not None:
                names = beside.get("keypoint_names") or []
                _write_angles(arguments.angles, truth, lift.points3d, names)
        means, sds = np.mean(found, 0), np.std(found, 0)
        figures = zip(WorldErrors._fields, means, sds, strict=True)
        yield {"noise, px": noise, "views": len(views)} | {
            name: f"{mean:.2f} ({sd:.2f})" for name, mean, sd in figures
        }


def detected(keypoints: ArrayLike, noise: float, seed: int, share: float = REPEATED) -> Float64:
    """Return keypoints (N, K, P, 2) with errors of `noise` pixels in all, that `share` repeated."""
    rng, pixels = np.random.default_rng([seed, 72]), np.array(keypoints, np.float64)
    repeated = share * noise
    own = np.sqrt(noise**2 - repeated**2) / np.sqrt(FREEDOM / (FREEDOM - 2))
    offsets = repeated * rng.standard_normal(pixels.shape[1:])
    pixels += offsets + own * rng.standard_t(FREEDOM, pixels.shape)
    return pixels


def world_errors(
    prior: FittedPrior, lift: LiftedFrames, truth: Float64, true: TrueLenses, width: int
) -> WorldErrors:
    """Compare a fit and its lift with the truth (N, P, 3) in metres, and with the true cameras."""
    found = prior.cameras
    if found is None or not found.static.all():
        raise ValueError("expected static cameras")
    points = in_room(lift, found.rotations, found.translations)
    onto = similarity(points, truth)
    centres = onto.of(_centres(found.rotations, found.translations))
    apart = np.linalg.norm(centres - _centres(true.rotations, true.translations), axis=-1)
    turned = found.rotations @ onto.rotation.T @ true.rotations.mT  # (K, 3, 3)
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1) / 2
    fields = [2 * np.degrees(np.arctan(width / 2 / f)) for f in (found.focals, true.lenses)]
    return WorldErrors(
        MILLIMETRES * float(np.nanmean(np.linalg.norm(onto.of(points) - truth, axis=-1))),
        MILLIMETRES * pa_mpjpe(lift.points3d, truth, reflection="never").mean,
        MILLIMETRES * float(apart.mean()),
        float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean()),
        float(np.abs(fields[0][:, 0] - fields[1][:, 0]).mean()),
    )


def in_room(lift: LiftedFrames, rotations: Float64, translations: Float64) -> Float64:
    """Return the structures (N, P, 3) in the frame of reference of static cameras.

    Each frame's own poses place its structure before the cameras; the first view that has one does.
    """
    points = np.full(lift.points3d.shape, np.nan)
    for k in range(len(rotations)):
        open_ones = np.isnan(points).all((1, 2)) & np.isfinite(lift.translations[:, k]).all(-1)
        ahead = lift.points3d @ lift.rotations[:, k].mT + lift.translations[:, k, None]
        placed = (ahead - translations[k]) @ rotations[k]
        points[open_ones] = placed[open_ones]
    return points


def similarity(points: Float64, truth: Float64) -> Similarity:
    """Return the similarity that brings points (N, P, 3) onto the truth by least squares.

    It never mirrors (Umeyama, *Least-squares estimation of transformation parameters between two
    point patterns*, 1991).
    """
    known = np.isfinite(points + truth).all(-1)
    x, y = points[known], truth[known]
    middle_x, middle_y = x.mean(0), y.mean(0)
    x, y = x - middle_x, y - middle_y
    rotation = nearest_rotations((y.T @ x)[None])[0]
    scale = float((y * (x @ rotation.T)).sum() / np.square(x).sum())
    return Similarity(scale, rotation, middle_y - scale * rotation @ middle_x)


def _centres(rotations: Float64, translations: Float64) -> Float64:
    return np.asarray(-(rotations.mT @ translations[..., None])[..., 0])


def _write_angles(path: Path, truth: Float64, points: ArrayLike, names: list[str]) -> None:
    """Write a row per frame and joint: its true angle and the estimated one, degrees."""
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("frame", "subject", "measure", "unit", "ref", "pred"))
        for side in ("left", "right"):
            for joint, three in JOINTS.items():
                places = [
                    [i for i, name in enumerate(names) if side in name.lower() and part in name]
                    for part in three
                ]
                if any(len(place) != 1 for place in places):
                    continue
                a, b, c = (place[0] for place in places)
                true, ours = (
                    angles(np.asarray(some, np.float64)[:, [a, b, c]]) for some in (truth, points)
                )
                for n, pair in enumerate(zip(true, ours, strict=True)):
                    if np.isfinite(pair).all():
                        numbers = (f"{value:.3f}" for value in pair)
                        table.writerow((n, "all", f"{side} {joint}", "deg", *numbers))


def angles(points: Float64) -> Float64:
    """Return the angles (N,) at the second of three points (N, 3, 3), degrees."""
    u, v = points[:, 0] - points[:, 1], points[:, 2] - points[:, 1]
    lengths = np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1)
    found: Float64 = np.degrees(np.arccos(((u * v).sum(-1) / lengths).clip(-1, 1)))
    return found


if __name__ == "__main__":
    main()
