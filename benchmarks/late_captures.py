"""Drawn films with views in step or late, before cameras that stand, pan or are carried.

`draw_film(number, half, data)` depends on the number, the half and the data alone. Motions and rigs
are those of `benchmarks/motions.py` and `benchmarks/drawn_captures.py`, with frames in a row.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import drawn_captures as drawn
from benchmarks.motions import CAPTURES, EXAMPLE, FPS, ROOT, courses, motions
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]

SEED = 5502
KINDS = ("static", "shaken", "panned", "carried")  # what cameras do
FRAMES = (60, 1000)
LATE = (0.3, 450.0)  # frames
OVERLAP = 0.4  # of a film's frames: so many at least are shared by all views
LATE_SHARE, TWO_LATE = 0.5, 0.3  # of draws, and of draws with late views and four views or more
STANDING = 0.5  # share of draws whose cameras do not move
SWAY = (0.001, 0.06)  # of a camera's distance, and radians


class Film(NamedTuple):
    """A film and by how many frames its views are late."""

    number: int
    words: str
    kind: str  # what the cameras do
    keypoints: Float64  # (N, K, P, 2) pixels, NaN where not observed
    late: Float64  # (K,) frames


def draw_film(number: int, half: str, data: Path | None = None) -> Film:
    """Draw film `number` of a half of the motions."""
    rng = np.random.default_rng([SEED, number, *half.encode()])
    frames = int(_log_uniform(FRAMES, rng))
    views = 2 if number % drawn.PAIRS == 0 else int(rng.choice([3, 4, 6], p=[0.4, 0.35, 0.25]))
    late = _lateness(number, frames, views, rng)
    kind = KINDS[0] if rng.random() < STANDING else str(rng.choice(KINDS[1:]))
    before, after = (int(np.ceil(max(0.0, way))) + 2 for way in (late.max(), -late.min()))
    name, points = _in_a_row(frames + before + after, half, data, rng)
    points, words = drawn.walking(points, rng, clip=True)
    lens = drawn.draw_lenses(views, rng)
    arrangement = str(rng.choice(drawn.ARRANGEMENTS))
    poses = drawn.place_cameras(points, lens, arrangement, rng)
    rotations, translations = _moved(kind, poses, points, before, frames, late, rng)
    exact = np.empty((frames, views, points.shape[1], 2))
    for view in range(views):
        shown = read_between(points, np.arange(frames) + before - late[view])
        exact[:, view : view + 1] = drawn.projected(
            shown,
            rotations[:, view : view + 1],
            translations[:, view : view + 1],
            lens.focals[view : view + 1],
            lens.centres[view : view + 1],
            lens.radial[view : view + 1],
        )
    keypoints, _, harms = drawn.detected(exact, lens, rng)
    by = ", ".join(f"{frames:.1f}" for frames in late)
    text = f"{name}, {frames} frames; {'; '.join(words)}; {views} views {arrangement}; {kind}"
    return Film(number, "; ".join((text, f"late {by}", *harms)), kind, keypoints, late)


def read_between(points: Float64, moments: Float64) -> Float64:
    """Read points (N, ...) at moments (T,) between frames, by cubics through four of them."""
    low = np.clip(np.floor(moments).astype(int), 1, len(points) - 3)
    share = (moments - low).reshape(-1, *[1] * (points.ndim - 1))
    p0, p1, p2, p3 = (points[low + step] for step in (-1, 0, 1, 2))
    bend = (2 - share) * (p0 - 2 * p1 + p2) + (1 + share) * (p1 - 2 * p2 + p3)
    read: Float64 = p1 + share * (p2 - p1) - share * (1 - share) / 6 * bend
    return read


def _lateness(number: int, frames: int, views: int, rng: np.random.Generator) -> Float64:
    """Draw by how many frames (K,) views are late: none in half of the draws, else one or two."""
    late = np.zeros(views)
    count = 0 if number % 2 == 0 else 1 + int(views > 3 and rng.random() < TWO_LATE)
    most = min(LATE[1], (1 - OVERLAP) * frames / count) if count else 0.0
    for view in rng.choice(views, count, replace=False):
        by = _log_uniform((LATE[0], most), rng) * rng.choice([-1, 1])
        late[view] = by if abs(by) < 1 or rng.random() < 0.5 else round(by)
    return late


def _in_a_row(
    frames: int, half: str, data: Path | None, rng: np.random.Generator
) -> tuple[str, Float64]:
    """Draw a motion of so many frames in a row: each kind is as likely, and all clips are one."""
    found = motions(half, data)
    clips = [name for name in found if name.startswith("clip ")]
    kinds = [name for name in found if name not in clips] + ["clip"] * bool(clips)
    while True:
        name = str(rng.choice(kinds))
        if name not in CAPTURES[half]:
            name = str(rng.choice(clips)) if name == "clip" else name
            return name, found[name](frames, rng)
        file = EXAMPLE if name == EXAMPLE.stem else (data or ROOT) / f"{name}.npz"
        with np.load(file) as arrays:
            truth = np.roll(arrays["points3d"].astype(np.float64), 2 - CAPTURES[half][name], axis=2)
        shown = np.isfinite(truth).all(-1).mean(1) > 0.8
        starts = np.flatnonzero(np.convolve(shown, np.ones(frames), "valid") == frames)
        if len(truth) >= frames and len(starts):
            start = int(rng.choice(starts))
            return name, truth[start : start + frames]


def _moved(
    kind: str,
    poses: tuple[Float64, Float64],
    points: Float64,
    before: int,
    frames: int,
    late: Float64,
    rng: np.random.Generator,
) -> tuple[Float64, Float64]:
    """Return the poses (N, K, ...) of cameras that stand, are shaken, pan or are carried."""
    rotations, translations = poses
    shape, sway = (frames, len(rotations)), _log_uniform(SWAY, rng)
    if kind == "shaken":
        return drawn.shaken(*poses, frames, rng)
    rotations = np.broadcast_to(rotations, (*shape, 3, 3))
    translations = np.broadcast_to(translations, (*shape, 3))
    if kind == "static":
        return rotations, translations
    centres = -(translations[..., None, :] @ rotations)[..., 0, :]  # (N, K, 3)
    turns = rotations_from_vectors(sway * courses(frames, (shape[1], 3), rng))
    if kind == "panned":  # after the subject, a little late
        middle = np.nanmean(points, 1)
        width = int(FPS / 2)
        ends = np.pad(middle, ((width, 0), (0, 0)), mode="edge")
        behind = np.stack([ends[i : i + len(middle)] for i in range(width)]).mean(0)
        for view in range(shape[1]):
            aim = read_between(behind, np.arange(frames) + before - late[view])
            towards = aim - centres[:, view]
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            right = np.cross(towards, [0.0, 0.0, 1.0])
            right /= np.linalg.norm(right, axis=1, keepdims=True)
            turns[:, view] = (
                turns[:, view]
                @ np.stack((right, np.cross(towards, right), towards), 1)
                @ rotations[:, view].mT
            )
    else:
        far = np.linalg.norm(translations, axis=-1, keepdims=True)
        centres = centres + sway * far * courses(frames, (shape[1], 3), rng)
    rotations = turns @ rotations
    return rotations, -(rotations @ centres[..., None])[..., 0]


def _log_uniform(ends: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(ends[0]), np.log(ends[1]))))
