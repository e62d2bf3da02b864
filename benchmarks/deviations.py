"""Whether the standard deviations of cameras are what they claim: errors over them, on drawn rigs.

`python -m benchmarks.deviations` draws rigs of several kinds, lets each be found from its keypoints
and prints the root mean square of error / standard deviation (1 is perfect) and the largest. The
lenses are drawn from what real ones are like, the answers of a network are imitated.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.bundle.problem import LENS, Scene
from models.calibrating.result import CameraReport, SelfCalibration, camera_report
from models.calibrating.self_calibration import self_calibrate, task_of
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import Lens, RigCapture, draw_rig_capture

Float64 = NDArray[np.float64]

IMAGE_SIZE = (1280, 1024)
NAMES = ("focal", "centre", "radial", "rotation", "translation")
FRAMES = 60


@dataclass(frozen=True)
class Kind:
    """A kind of rig."""

    views: int
    alike: bool = True
    sized: bool = True
    moving: tuple[int, ...] = ()

    def __str__(self) -> str:
        """Name it in a few words."""
        words = [f"{self.views} views", "alike" if self.alike else "unlike"]
        words += [] if self.sized else ["no sizes"]
        words += [f"{len(self.moving)} moving"] if self.moving else []
        return ", ".join(words)


KINDS = (
    Kind(2),
    Kind(2, sized=False),
    Kind(3),
    Kind(3, sized=False),
    Kind(3, alike=False),
    Kind(3, alike=False, sized=False),
    Kind(6),
    Kind(6, alike=False),
    Kind(6, alike=False, sized=False),
    Kind(2, moving=(0, 1)),
    Kind(3, moving=(0, 1, 2)),
    Kind(3, moving=(2,)),
)


def draw(kind: Kind, seed: int, frames: int = FRAMES, noise: float = 1.5) -> RigCapture:
    """Draw a rig of a kind and its keypoints of a figure that walks about."""
    rng = np.random.default_rng([seed, kind.views, kind.alike])
    common = 1100 * np.exp(0.15 * rng.standard_normal())
    bending = 0.05 * rng.standard_normal()
    lenses = []
    for _ in range(kind.views):
        apart = 0.005 * rng.standard_normal() if kind.alike else rng.uniform(-1, 1) * np.log(2)
        offset = 0.01 * max(IMAGE_SIZE) * rng.standard_normal(2)
        centre = offset + np.array(IMAGE_SIZE) / 2
        own = bending + 0.01 * rng.standard_normal()
        lenses.append(
            Lens(float(common * np.exp(apart)), (float(centre[0]), float(centre[1])), (own,))
        )
    return draw_rig_capture(lenses, frames=frames, moving=kind.moving, noise=noise, rng=rng)


def found_by(capture: RigCapture, *, sized: bool, seed: int = 0) -> tuple[SelfCalibration, Scene]:
    """Estimate the cameras, with or without given image sizes."""
    sizes = [IMAGE_SIZE] * len(capture.lenses) if sized else None
    return finished(
        self_calibrate(
            task_of(capture.pixels, capture.weights, FitConfig(), sizes), capture.answers(seed=seed)
        )
    )


def scores(capture: RigCapture, found: SelfCalibration, scene: Scene) -> dict[str, Float64]:
    """Errors over their standard deviations: by name, each (n,)."""
    report = camera_report(found)
    lenses = capture.lenses
    focals = np.array([lens.focal for lens in lenses])
    centres = np.array([lens.centre for lens in lenses])
    radial = np.array([(*lens.distortion, 0.0, 0.0)[:2] for lens in lenses])
    found_scores = {
        "focal": (report.focals.mean(1) - focals) / report.focal_sds,
        "centre": ((report.principal_points - centres) / report.principal_point_sds).ravel(),
        "radial": ((report.distortions[:, :2] - radial) / report.distortion_sds).ravel(),
    }
    static = np.flatnonzero(report.static)
    if len(static):
        found_scores |= _scores_of_poses(capture, report, found, scene, static)
    return found_scores


def _scores_of_poses(
    capture: RigCapture,
    report: CameraReport,
    found: SelfCalibration,
    scene: Scene,
    static: NDArray[np.int64],
) -> dict[str, Float64]:
    first, others = static[0], static[1:]
    truth, shifts = capture.rotations[0], capture.translations[0]
    relative = truth[others] @ truth[first].T
    apart = Rotation.from_matrix(report.rotations[others] @ relative.mT)
    between = shifts[others] - relative @ shifts[first]
    # In units of the structures, of which the mean log size is known in both.
    group = found.rig.groups[first]
    ours = np.exp(scene.sizes[:, group].mean() + _log_sizes(scene.points).mean())
    scale = ours / np.exp(_log_sizes(capture.points3d).mean())
    misplaced = report.translations[others] - scale * between
    sds = found.deviations[others]
    return {
        "rotation": (apart.as_rotvec() / sds[:, LENS : LENS + 3]).ravel(),
        "translation": (misplaced / report.translation_sds[others]).ravel(),
    }


def _log_sizes(points: Float64) -> Float64:
    """Log root-mean-square radii (N,) of structures (N, P, 3)."""
    centred = points - points.mean(1, keepdims=True)
    sizes: Float64 = np.log(np.square(centred).sum(-1).mean(-1)) / 2
    return sizes


def table(kinds: Sequence[Kind], seeds: range) -> dict[Kind, dict[str, Float64]]:
    """Score rigs of all kinds, and print a line for each."""
    every: dict[Kind, dict[str, Float64]] = {}
    for kind in kinds:
        parts: dict[str, list[Float64]] = {name: [] for name in NAMES}
        errors, moved = [], 0
        for seed in seeds:
            capture = draw(kind, seed)
            found, scene = found_by(capture, sized=kind.sized, seed=seed)
            expected = [view not in kind.moving for view in range(kind.views)]
            moved += found.static.tolist() != (
                expected if sum(expected) > 1 else [False] * kind.views
            )
            for name, part in scores(capture, found, scene).items():
                parts[name].append(part)
            focals = np.array([lens.focal for lens in capture.lenses])
            errors.append(np.abs(found.rig.lenses.focals.mean(1) / focals - 1).max())
        every[kind] = {name: np.concatenate(part) for name, part in parts.items() if part}
        figures = [
            f"{name} {np.sqrt(np.square(z).mean()):.2f} ({np.abs(z).max():.1f})"
            for name, z in every[kind].items()
        ]
        worst = 100 * np.median(errors), 100 * max(errors)
        print(
            f"{kind!s:34}",
            *(f"{figure:>24}" for figure in figures),
            f"focal off {worst[0]:.1f} % ({worst[1]:.1f})",
            f"arranged wrongly {moved}" if moved else "",
            flush=True,
        )
    return every


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--kinds", type=int, nargs="*", default=range(len(KINDS)))
    options = parser.parse_args()
    table([KINDS[number] for number in options.kinds], range(options.seeds))
