"""Captures drawn by number: motions before rigs, lenses and detectors that nobody chose.

`draw_capture(number, data)` is the same everywhere, for it depends on the number alone. Without a
half its motions are the ground truths of five captures; else those of `benchmarks/motions.py`. A
number whose motion is not at hand is no draw.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.motions import EXAMPLE, ROOT, chosen, motions, taken
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

SEED = 3401
# How often each motion is drawn, and which axis of its frame points up.
MOTIONS = {
    "three_actors": (0.25, 1),
    "cmu_mocap_virtual6": (0.35, 1),
    "human36m": (0.2, 2),
    "monkey": (0.1, 1),
    "dannce_mouse1": (0.1, 2),
}
VIEWS = {3: 0.4, 4: 0.35, 6: 0.25}  # of draws that are no pairs
PAIRS = 3  # each third draw is a pair
MOVING = 0.1  # share of draws whose cameras move
FRAMES = (40, 300)
SIDES = (640, 1280, 1920, 3840)
FOCALS = (0.5, 2.5)  # longer sides of the image
RADIAL = (-0.25, 0.1)
LEAST_SIZE = 20.0  # pixels, height of the smallest subject: four times the root-mean-square radius
HEIGHT = 4.0
STATIC, SHAKEN = "static", "shaken"
ARRANGEMENTS = ("narrow", "wide", "around", "facing")
NOISE = (0.001, 0.05)  # of the subject's height in the image
CLEAN = 0.2  # share of draws without noise
NEAREST = 0.3  # of a camera's distance: the least depth that any keypoint may have


class Draw(NamedTuple):
    """A capture and all that is true of it."""

    number: int
    words: str  # what was drawn
    keypoints: Float64  # (N, K, P, 2) pixels, NaN where not observed
    sizes: list[tuple[int, int]] | None  # of the images, if a fit may know them
    points3d: Float64  # (N, P, 3) in the room
    rotations: Float64  # (N, K, 3, 3) x_camera = R x_room + t
    translations: Float64  # (N, K, 3)
    focals: Float64  # (K,) pixels, the median of `frame_focals`
    centres: Float64  # (K, 2) pixels, the median of `frame_centres`
    radial: Float64  # (K,) first radial coefficient
    noise: float  # pixels, standard deviation of a coordinate
    images: Float64  # (K, 2) their sizes
    kinds: tuple[str, ...]  # of the K cameras: `STATIC`, or how they move
    frame_focals: Float64  # (N, K, 2) pixels across and down
    frame_centres: Float64  # (N, K, 2)
    times: Float64 | None = None  # (N,) seconds, if a fit may know them

    @property
    def static(self) -> Bool:
        """Which cameras (K,) neither move nor show another part of their image in each frame."""
        return np.array([kind == STATIC for kind in self.kinds])

    @property
    def moving(self) -> bool:
        """Whether any camera is not static."""
        return not self.static.all()

    @property
    def height(self) -> float:
        """The subject's height: four root-mean-square radii of a frame, by the median."""
        return HEIGHT * radius(self.points3d)

    @property
    def seen_twice(self) -> Bool:
        """Which keypoints (N, P) two views or more see."""
        seen: Bool = np.isfinite(self.keypoints).all(-1).sum(1) > 1
        return seen


def draw_capture(number: int, data: Path | None = None, half: str | None = None) -> Draw | None:
    """Draw capture `number`; None if its motion is not in the folder `data`."""
    rng = np.random.default_rng([SEED, number] if half is None else [SEED, number, *half.encode()])
    names = list(MOTIONS)
    name = names[rng.choice(len(names), p=[share for share, _ in MOTIONS.values()])]
    pair, moving = number % PAIRS == 0, bool(rng.random() < MOVING)
    views = 2 if pair else int(rng.choice(list(VIEWS), p=list(VIEWS.values())))
    if half is None:
        file = EXAMPLE if name == EXAMPLE.stem else (data or ROOT) / f"{name}.npz"
        if not file.exists():
            return None
        with np.load(file) as arrays:
            truth = arrays["points3d"].astype(np.float64)
        points, words = _motion(truth, MOTIONS[name][1], rng)
    else:
        name, points = _of_half(half, data, rng)
        points, words = walking(points, rng, clip=True)
    lens = draw_lenses(views, rng)
    arrangement = ARRANGEMENTS[int(rng.integers(len(ARRANGEMENTS)))]
    rotations, translations = place_cameras(points, lens, arrangement, rng)
    if moving:
        rotations, translations = shaken(rotations, translations, len(points), rng)
    shape = (len(points), views)
    rotations = np.broadcast_to(rotations, (*shape, 3, 3))
    translations = np.broadcast_to(translations, (*shape, 3))
    exact = projected(points, rotations, translations, lens.focals, lens.centres, lens.radial)
    keypoints, noise, harms = detected(exact, lens, rng)
    sized = bool(rng.random() < 0.7)
    words = [
        f"{name}, {len(points)} frames",
        *words,
        f"{views} views {arrangement}",
        "moving" if moving else "static",
        "like lenses" if np.ptp(lens.focals / lens.sizes.max(1)) == 0 else "unlike lenses",
        f"f {', '.join(f'{f:.2f}' for f in lens.focals / lens.sizes.max(1))}",
        f"height {HEIGHT * float(np.nanmedian(radii(exact))):.0f} px",
        "sizes" if sized else "no sizes",
        *harms,
    ]
    return Draw(
        number,
        "; ".join(words),
        keypoints,
        [(int(w), int(h)) for w, h in lens.sizes] if sized else None,
        points,
        rotations,
        translations,
        lens.focals,
        lens.centres,
        lens.radial,
        noise,
        lens.sizes,
        (SHAKEN if moving else STATIC,) * views,
        np.broadcast_to(lens.focals[:, None], (*shape, 2)),
        np.broadcast_to(lens.centres, (*shape, 2)),
    )


def projected(
    points: Float64,
    rotations: Float64,
    translations: Float64,
    focals: Float64,
    centres: Float64,
    radial: Float64,
) -> Float64:
    """Pixels (N, K, P, 2) of points (N, P, 3) in cameras with one radial coefficient.

    `focals` are (K,) or (N, K, 2), `centres` (K, 2) or (N, K, 2).
    """
    held = points[:, None] @ rotations.mT + translations[:, :, None]  # (N, K, P, 3)
    flat = held[..., :2] / held[..., 2:]
    gain = 1 + radial[:, None, None] * np.square(flat).sum(-1, keepdims=True)
    focals = focals[:, None] if focals.ndim == 1 else focals
    pixels: Float64 = focals[..., None, :] * gain * flat + centres[..., None, :]
    return pixels


class DrawnLenses(NamedTuple):
    """Lenses of K cameras, in pixels."""

    sizes: Float64  # (K, 2)
    focals: Float64  # (K,)
    centres: Float64  # (K, 2)
    radial: Float64  # (K,)


def _motion(truth: Float64, up: int, rng: np.random.Generator) -> tuple[Float64, list[str]]:
    """Return frames (N, P, 3) of a motion about the origin with z up, and what was drawn."""
    points, clip = taken(truth, up, int(log_uniform(FRAMES, rng)), rng)
    points, words = walking(points, rng, clip=clip)
    return points, ["clip" if clip else "scattered", *words]


def _of_half(half: str, data: Path | None, rng: np.random.Generator) -> tuple[str, Float64]:
    """Draw a motion."""
    found = motions(half, data)
    name = chosen(found, rng)
    return name, found[name](int(log_uniform(FRAMES, rng)), rng)


def walking(points: Float64, rng: np.random.Generator, *, clip: bool) -> tuple[Float64, list[str]]:
    """Return points about the origin, or on a way of their own, and what was drawn."""
    points = points - np.nanmean(points, 1, keepdims=True)
    walks = bool(rng.random() < 0.6)
    if walks:
        reach = radius(points) * rng.uniform(1, 5)
        if clip:
            steps = rng.standard_normal((len(points), 2)).cumsum(0)
            path = steps - steps.mean(0)
            path *= reach / max(float(np.abs(path).max()), 1e-9)
        else:
            path = rng.uniform(-reach, reach, (len(points), 2))
        points[..., :2] += path[:, None]
    return points, ["walking" if walks else "centred"]


def draw_lenses(views: int, rng: np.random.Generator) -> DrawnLenses:
    """Draw the lenses of a rig."""
    like = bool(rng.random() < 0.6)
    side = float(rng.choice(SIDES))
    portrait = bool(rng.random() < 0.2)
    size = np.array([side, round(side * 9 / 16)])
    sizes = np.tile(size[::-1] if portrait else size, (views, 1))
    focals = np.array([log_uniform(FOCALS, rng) for _ in range(views)])
    radial = rng.uniform(*RADIAL, views)
    if like:
        focals[:], radial[:] = focals[0], radial[0]
    # Long lenses hardly bend: what they show lies near their axis.
    radial = radial * np.minimum(1, focals**2)
    centres = sizes / 2 + 0.01 * side * rng.standard_normal((views, 2))
    return DrawnLenses(sizes, focals * side, centres, radial)


def place_cameras(
    points: Float64,
    lens: DrawnLenses,
    arrangement: str,
    rng: np.random.Generator,
    *,
    framed: Float64 | None = None,
) -> tuple[Float64, Float64]:
    """Return rotations (K, 3, 3) and translations (K, 3) of cameras that look at the motion.

    The images are as large as the points `framed` need, by default all.
    """
    framed = points if framed is None else framed
    views = len(lens.focals)
    start = rng.uniform(0, 2 * np.pi)
    if arrangement == "facing":
        turns = start + np.pi * (np.arange(views) % 2) + rng.uniform(-0.3, 0.3, views)
    else:
        arc = {
            "narrow": rng.uniform(0.17, 1.0),
            "wide": rng.uniform(1.0, 3.0),
            "around": 2 * np.pi * (1 - 1 / views),
        }[arrangement]
        turns = start + np.linspace(0, arc, views) + 0.1 * arc / views * rng.standard_normal(views)
    tilts = rng.uniform(-0.1, 0.6, views)
    extent = float(np.nanmax(np.linalg.norm(points, axis=-1)))
    spread = float(np.sqrt(np.nanmean(np.square(framed).sum(-1))))
    share = lens.focals / lens.sizes.min(1)  # of the shorter side
    nearest = np.maximum(extent / (1 - NEAREST), 2.2 * spread * share.max())
    furthest = HEIGHT * radius(points) * lens.focals.min() / LEAST_SIZE
    furthest = max(nearest * 1.1, min(furthest, 12 * nearest))
    distance = np.exp(rng.uniform(np.log(nearest), np.log(furthest)))
    distances = distance * np.exp(0.1 * np.abs(rng.standard_normal(views)))
    rotations, translations = np.empty((views, 3, 3)), np.empty((views, 3))
    for k in range(views):
        forward = -np.array(
            [
                np.cos(tilts[k]) * np.cos(turns[k]),
                np.cos(tilts[k]) * np.sin(turns[k]),
                np.sin(tilts[k]),
            ]
        )
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        look = np.stack((right, np.cross(forward, right), forward))
        aside = rotations_from_vectors(0.05 * rng.standard_normal(3) / share[k])
        rotations[k] = aside @ look
        translations[k] = rotations[k] @ (distances[k] * forward)
    return rotations, translations


def shaken(
    rotations: Float64, translations: Float64, frames: int, rng: np.random.Generator
) -> tuple[Float64, Float64]:
    """Return poses (N, K, ...) of cameras that people carry about the subject."""
    views = len(rotations)
    steps = rng.standard_normal((frames, views, 4)).cumsum(0)
    steps -= steps.mean(0)
    steps /= np.abs(steps).max(0).clip(1e-9)
    turn = np.zeros((frames, views, 3))
    turn[..., 2] = 0.3 * steps[..., 0]  # about the subject
    about = rotations @ rotations_from_vectors(turn)
    aside = rotations_from_vectors(0.03 * steps[..., 1:4])
    depth = np.linalg.norm(translations, axis=1)[None, :, None]
    return aside @ about, (aside @ translations[None, ..., None])[..., 0] + 0.03 * depth * steps[
        ..., 1:4
    ]


def detected(
    exact: Float64, lens: DrawnLenses, rng: np.random.Generator
) -> tuple[Float64, float, list[str]]:
    """Return what a detector makes of exact keypoints, its noise in pixels, and what was drawn."""
    frames, views, points = exact.shape[:3]
    pixels, harms, noise = exact.copy(), [], 0.0
    if rng.random() >= CLEAN:
        share = log_uniform(NOISE, rng)
        noise = share * HEIGHT * float(np.nanmedian(radii(exact)))
        levels = noise * np.exp(0.3 * rng.standard_normal(points))
        tails = bool(rng.random() < 0.4)
        unit = rng.standard_t(4, exact.shape) / np.sqrt(2) if tails else None
        unit = rng.standard_normal(exact.shape) if unit is None else unit
        pixels += levels[:, None] * unit
        harms.append(f"noise {100 * share:.2f} %{' with tails' if tails else ''}")
    if rng.random() < 0.5:
        gaps = rng.uniform(0, 0.2)
        pixels[rng.random(exact.shape[:3]) < gaps] = np.nan
        harms.append(f"gaps {100 * gaps:.0f} %")
    if rng.random() < 0.2:
        share = rng.uniform(0, 0.05)
        stray = rng.random(exact.shape[:3]) < share
        anywhere = rng.uniform(0, 1, exact.shape) * lens.sizes[:, None]
        pixels = np.where(stray[..., None] & np.isfinite(pixels), anywhere, pixels)
        harms.append(f"outliers {100 * share:.1f} %")
    if rng.random() < 0.15:
        pixels[:, :, int(rng.integers(points))] = np.nan
        harms.append("a keypoint never seen")
    if rng.random() < 0.1:
        pixels[: frames // 3, int(rng.integers(views))] = np.nan
        harms.append("a view late")
    outside = ((pixels < 0) | (pixels > lens.sizes[:, None])).any(-1)
    pixels[outside] = np.nan
    if rng.random() < 0.1:
        pixels = np.rint(pixels)
        harms.append("whole pixels")
    return pixels, noise, harms


def log_uniform(ends: tuple[float, float], rng: np.random.Generator) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(ends[0]), np.log(ends[1]))))


def radii(points: Float64) -> Float64:
    """Root-mean-square radii (...,) of sets of points (..., P, D) about their means."""
    centred = points - np.nanmean(points, -2, keepdims=True)
    radii: Float64 = np.sqrt(np.nanmean(np.square(centred).sum(-1), -1))
    return radii


def radius(points: Float64) -> float:
    """Return the root-mean-square radius of structures (N, P, D), the median over frames."""
    return float(np.nanmedian(radii(points)))
