"""A figure before perspective cameras whose lenses and poses are known."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.bundle.initial_poses import WeakPerspectiveScene
from models.capture.synthetic import KEYPOINT_NAMES, synthetic_capture
from models.settings.calibration import LensName

Float64 = NDArray[np.float64]
IMAGE_SIZE = (1280, 1024)
FOCAL = 1100.0
MIRROR = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Lens:
    """OpenCV's pinhole with radial distortion (k1, k2), or its fisheye (k1 to k4)."""

    focal: float = FOCAL
    centre: tuple[float, float] = (640.0, 512.0)
    distortion: tuple[float, ...] = ()
    model: LensName = "pinhole"

    def project(self, points: Float64) -> Float64:
        """Pixels (..., 2) of points (..., 3) in the camera's frame."""
        flat = points[..., :2] / points[..., 2:]
        radius = np.linalg.norm(flat, axis=-1, keepdims=True)
        bent = np.arctan(radius) if self.model == "fisheye" else radius
        factor = sum((k * bent ** (2 * i) for i, k in enumerate(self.distortion, start=1)), 1.0)
        pixels: Float64 = self.focal * flat * bent * factor / radius + self.centre
        return pixels


@dataclass(frozen=True)
class RigCapture:
    """N frames of K views of P keypoints."""

    keypoints: Float64  # (N, K, P, 2) pixels, NaN where not observed
    points3d: Float64  # (N, P, 3) metres
    rotations: Float64  # (N, K, 3, 3) x_cam = R x + t
    translations: Float64  # (N, K, 3) metres
    lenses: tuple[Lens, ...]

    def part(self, frames: slice) -> "RigCapture":
        """Return some of the frames."""
        return RigCapture(
            self.keypoints[frames],
            self.points3d[frames],
            self.rotations[frames],
            self.translations[frames],
            self.lenses,
        )

    @property
    def weights(self) -> Float64:
        """1 where a keypoint was observed, (N, K, P)."""
        return np.asarray(np.isfinite(self.keypoints).all(-1), np.float64)

    @property
    def pixels(self) -> Float64:
        """Keypoints with 0 where none was observed."""
        return np.where(np.isfinite(self.keypoints), self.keypoints, 0.0)

    def answers(self, *, mirrored: bool = False, seed: int = 0) -> WeakPerspectiveScene:
        """Structures and cameras such as a network might find.

        They are off by some 7 degrees and a tenth of the radius, and optionally
        all mirror images. Frames share their frame of reference.
        """
        rng = np.random.default_rng(seed)
        points, rotations = [], []
        first = self.points3d[0] - self.points3d[0].mean(0)
        for frame, turned in zip(self.points3d, self.rotations, strict=True):
            centred = frame - frame.mean(0)
            heading, _ = Rotation.align_vectors(first, centred)
            off = Rotation.from_rotvec(np.radians(4) * rng.standard_normal((len(turned), 3)))
            points.append(heading.apply(centred))
            rotations.append(off.as_matrix() @ turned @ heading.as_matrix().T)
        structures, views = np.stack(points), np.stack(rotations)
        radius = np.sqrt(np.square(structures).sum(-1).mean(-1))  # (N,)
        structures = structures / radius[:, None, None]
        structures = structures + 0.06 * rng.standard_normal(structures.shape)
        centre = self.points3d.mean(1)[:, None, :, None]
        middle = (self.rotations @ centre)[..., 0] + self.translations  # (N, K, 3)
        focals = np.array([lens.focal for lens in self.lenses])
        scales = focals * radius[:, None] / middle[..., 2]
        scales = scales * np.exp(0.03 * rng.standard_normal(scales.shape))
        shifts = np.stack(
            [lens.project(middle[:, k]) for k, lens in enumerate(self.lenses)], axis=1
        )
        if mirrored:
            structures, views = structures @ MIRROR, MIRROR @ views @ MIRROR
        return WeakPerspectiveScene(structures, views, scales, shifts)


def around(azimuths: list[float], distance: float = 4.0) -> tuple[Float64, Float64]:
    """Rotations (K, 3, 3) and translations (K, 3) of static cameras that look at one place."""
    rotations, translations = [], []
    for number, azimuth in enumerate(azimuths):
        tilt = [-8.0, -20.0, -3.0][number % 3]
        # Of the figure's axes (y up) the camera's y is down and its z looks at the figure.
        turn = Rotation.from_euler("yxz", [180 + azimuth, tilt, 180], degrees=True).inv()
        rotations.append(turn.as_matrix())
        translations.append([0.05 * number, 0.1, distance + 0.3 * number])
    return np.stack(rotations), np.array(translations)


def make_rig_capture(
    azimuths: list[float],
    *,
    frames: int = 60,
    moving: tuple[int, ...] = (),
    lenses: tuple[Lens, ...] = (Lens(),),
    noise: float = 1.0,
    distance: float = 4.0,
    hidden: float = 0.05,
    seed: int = 0,
) -> RigCapture:
    """Make a capture of a figure that walks about; views `moving` go round it from frame to frame.

    Lenses repeat if they are fewer than the views. The figure does the same whatever the cameras.
    """
    rng = np.random.default_rng(seed)
    figure = synthetic_capture(frames=frames, views=1, seed=seed).points3d.astype(np.float64)
    figure += rng.uniform(-0.4, 0.4, (frames, 1, 3)) * [1, 0.2, 1]
    rotation, translation = around(azimuths, distance)
    rotations = np.stack([rotation] * frames)
    translations = np.stack([translation] * frames)
    for view in moving:
        for n, azimuth in enumerate(rng.uniform(-180, 180, frames)):
            turned, shift = around([azimuth], distance)
            roll = Rotation.from_rotvec(0.1 * rng.standard_normal(3)).as_matrix()
            rotations[n, view] = roll @ turned[0]
            translations[n, view] = shift[0] + 0.2 * rng.standard_normal(3)
    camera = figure[:, None] @ rotations.transpose(0, 1, 3, 2) + translations[:, :, None]
    used = tuple(lens for lens, _ in zip(cycle(lenses), azimuths, strict=False))
    keypoints = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(used)], axis=1)
    keypoints += noise * rng.standard_normal(keypoints.shape)
    keypoints[rng.random(keypoints.shape[:3]) < hidden] = np.nan
    return RigCapture(keypoints, figure, rotations, translations, used)


def draw_rig_capture(
    lenses: Sequence[Lens],
    *,
    frames: int,
    noise: float,
    rng: np.random.Generator,
    moving: tuple[int, ...] = (),
) -> RigCapture:
    """Make a capture of a figure that walks about between cameras all around.

    Longer lenses stand farther away; views `moving` go round from frame to frame.
    """
    views = len(lenses)
    figure = synthetic_capture(
        frames=frames, views=1, seed=int(rng.integers(1 << 30))
    ).points3d.astype(np.float64)
    figure += rng.uniform(-0.6, 0.6, (frames, 1, 3)) * [1, 0.2, 1]
    angles = 360 / views * np.arange(views) + rng.uniform(-20, 20, views)
    rotations, translations = np.empty((frames, views, 3, 3)), np.empty((frames, views, 3))
    for view, lens in enumerate(lenses):
        distance = 4 * np.clip(lens.focal / 1100, 0.6, 2) * rng.uniform(0.9, 1.2)
        turned = [rng.uniform(-180, 180, frames), rng.uniform(-35, 5, frames)]
        if view not in moving:
            turned = [np.full(frames, angles[view]), np.full(frames, rng.uniform(-35, 5))]
        turns = np.stack((180 + turned[0], turned[1], np.full(frames, 180.0)), -1)
        roll = 0.05 * rng.standard_normal((frames if view in moving else 1, 3))
        turn = Rotation.from_rotvec(roll) * Rotation.from_euler("yxz", turns, degrees=True).inv()
        rotations[:, view] = turn.as_matrix()
        aside = 0.1 * rng.standard_normal((frames if view in moving else 1, 3))
        translations[:, view] = aside + np.array([0, 0, distance])
    camera = figure[:, None] @ rotations.mT + translations[:, :, None]
    keypoints = np.stack([lens.project(camera[:, k]) for k, lens in enumerate(lenses)], axis=1)
    keypoints += noise * rng.standard_normal(keypoints.shape)
    keypoints[rng.random(keypoints.shape[:3]) < 0.05] = np.nan
    return RigCapture(keypoints, figure, rotations, translations, tuple(lenses))


def keypoint(name: str) -> int:
    """Return the index of a keypoint of the figure."""
    return KEYPOINT_NAMES.index(name)
