"""Captures drawn by number whose cameras move, or show another part of their image in each frame.

`draw_moving(number, data, half, kind)` is the same everywhere, as those of `drawn_captures.py`.
Motions are in a row and smooth in time, and so are the cameras. Each camera of a draw has a kind:

- `hand_held`: somebody walks about the subject, with a hand that shakes;
- `panning`: a tripod whose head follows the subject, and sometimes zooms;
- `cropped`: a static camera of which a detector sees a box about the subject, resized;
- `drifting`: a tripod that sinks or turns a little.

A `mixed` draw has static cameras beside others, and the rig of a `carried` one moves as one: its
cameras are static to each other, so it counts as static, and its points are in the rig's own frame.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn_captures import (
    ARRANGEMENTS,
    HEIGHT,
    PAIRS,
    SEED,
    STATIC,
    VIEWS,
    Draw,
    DrawnLenses,
    detected,
    draw_lenses,
    log_uniform,
    place_cameras,
    projected,
    radii,
    radius,
)
from benchmarks.motions import FPS, chosen, courses, motions
from models.numerics.rotations import rotations_from_vectors

Float64 = NDArray[np.float64]

HAND_HELD, PANNING, CROPPED, DRIFTING = "hand_held", "panning", "cropped", "drifting"
MIXED, CARRIED = "mixed", "carried"
KINDS = (HAND_HELD, PANNING, CROPPED, MIXED, CARRIED, DRIFTING)
ANY = "any"  # each kind in turn
AMONG_STATIC = {HAND_HELD: 0.4, PANNING: 0.4, CROPPED: 0.2}  # what moves in a mixed draw
FRAMES = (60, 300)
RATES = (25.0, 50.0)  # frames a second
ARC = (20.0, 90.0)  # degrees that somebody walks about the subject
SHAKE = (0.5, 2.0)  # degrees, of a hand
SHAKES = (1.0, 5.0)  # cycles a second
AIMS = (0.05, 0.4)  # cycles a second of what one who follows the subject is off
OFF = 0.04  # of half the shorter side: its standard deviation
LAG = (0.1, 0.4)  # seconds that one who follows the subject is behind
ZOOM = 2.0  # largest over smallest focal length of a view
BOXES = ((192, 256), (288, 384), (256, 256))  # width, height
MARGIN = (1.1, 1.5)  # of the subject's extent in the image
JITTER = 0.04  # of a box: of its place and of the logarithm of its size
SMOOTH = 9  # frames over which boxes are smoothed
DRIFT = (0.3, 3.0)  # degrees


class _Cameras(NamedTuple):
    rotations: Float64  # (N, K, 3, 3)
    translations: Float64  # (N, K, 3)
    focals: Float64  # (N, K, 2)
    centres: Float64  # (N, K, 2)


def draw_moving(number: int, data: Path | None, half: str, kind: str) -> Draw:
    """Draw capture `number` of a kind of cameras, with the motions of a half."""
    if kind == ANY:  # pairs are every third number, so a kind stays for three
        kind = KINDS[number // PAIRS % len(KINDS)]
    rng = np.random.default_rng([SEED, number, *half.encode(), *kind.encode()])
    views = 2 if number % PAIRS == 0 else int(rng.choice(list(VIEWS), p=list(VIEWS.values())))
    kinds = _kinds(kind, views, rng)
    fps = float(rng.choice(RATES))
    name, body, points = _motion(half, data, fps, rng, rides=kind == CARRIED)
    lens = draw_lenses(views, rng)
    arrangement = ARRANGEMENTS[int(rng.integers(len(ARRANGEMENTS)))]
    followed = all(one in (HAND_HELD, PANNING) for one in kinds)
    placed = place_cameras(points, lens, arrangement, rng, framed=body if followed else None)
    cameras, words = _moved(points, placed, lens, kinds, fps, rng)
    exact = projected(points, *cameras, lens.radial)
    outside = ((exact < 0) | (exact > lens.sizes[:, None])).any(-1)
    exact[outside] = np.nan
    for k, one in enumerate(kinds):
        if one == CROPPED:
            words.append(_crop(k, exact, cameras, lens, rng))
    keypoints, noise, harms = detected(exact, lens, rng)
    sized, timed = bool(rng.random() < 0.7), bool(rng.random() < 0.6)
    shares = np.median(cameras.focals.mean(2), 0) / lens.sizes.max(1)
    words = [
        f"{name}, {len(points)} frames",
        f"{views} views {arrangement}",
        f"{kind} ({', '.join(kinds)})" if len(set(kinds)) > 1 else kind,
        *sorted(set(words)),
        f"f {', '.join(f'{share:.2f}' for share in shares)}",
        f"height {HEIGHT * float(np.nanmedian(radii(exact))):.0f} px",
        "sizes" if sized else "no sizes",
        f"{fps:.0f} fps" if timed else "no times",
        *harms,
    ]
    return Draw(
        number,
        "; ".join(words),
        keypoints,
        [(int(w), int(h)) for w, h in lens.sizes] if sized else None,
        points,
        cameras.rotations,
        cameras.translations,
        np.median(cameras.focals.mean(2), 0),
        np.median(cameras.centres, 0),
        lens.radial,
        noise,
        lens.sizes,
        kinds,
        cameras.focals,
        cameras.centres,
        np.arange(len(points)) / fps if timed else None,
    )


def _kinds(kind: str, views: int, rng: np.random.Generator) -> tuple[str, ...]:
    """Return the kind of each view; some that move and some that do not if they are mixed."""
    if kind == CARRIED:
        return (STATIC,) * views
    if kind == MIXED:
        move = rng.permutation(views) < rng.integers(1, views)
        drawn = rng.choice(list(AMONG_STATIC), views, p=list(AMONG_STATIC.values()))
        return tuple(str(one) if there else STATIC for one, there in zip(drawn, move, strict=True))
    if kind == DRIFTING:
        drift = rng.permutation(views) < rng.integers(1, views + 1)
        return tuple(DRIFTING if there else STATIC for there in drift)
    return (kind,) * views


def _motion(
    half: str, data: Path | None, fps: float, rng: np.random.Generator, *, rides: bool
) -> tuple[str, Float64, Float64]:
    """Return a motion's name, its frames (N, P, 3) about the origin, and the same as they walk.

    With `rides` they are as a rig sees them that somebody carries.
    """
    found = motions(half, data, in_a_row=True)
    name = chosen(found, rng)
    stride = round(FPS / fps)
    body = found[name](stride * int(log_uniform(FRAMES, rng)), rng)[::stride]
    body = body - np.nanmean(body, 1, keepdims=True)
    frames, points = len(body), body.copy()
    if rng.random() < 0.8:
        path = courses(frames, (2,), rng, between=(0.05, 0.4), fps=fps)
        path -= path.mean(0)
        reach = radius(body) * rng.uniform(1, 5)
        points[..., :2] += (reach * path / max(float(np.abs(path).max()), 1e-9))[:, None]
    if rides:
        turn = np.radians(rng.uniform(*SHAKE)) * courses(frames, (3,), rng, between=SHAKES, fps=fps)
        turn[:, 2] += (
            rng.uniform(0.2, 0.8) * courses(frames, (1,), rng, between=AIMS, fps=fps)[:, 0]
        )
        points = points @ rotations_from_vectors(turn).mT
        aside = courses(frames, (3,), rng, between=AIMS, fps=fps)
        points += 0.5 * radius(body) * (aside * [1, 1, 0.2])[:, None]
    return name, body, points


def _moved(
    points: Float64,
    placed: tuple[Float64, Float64],
    lens: DrawnLenses,
    kinds: tuple[str, ...],
    fps: float,
    rng: np.random.Generator,
) -> tuple[_Cameras, list[str]]:
    """Move cameras that are `placed` each in its own way; return them, and what was drawn."""
    frames, views = len(points), len(kinds)
    cameras = _Cameras(
        np.tile(placed[0], (frames, 1, 1, 1)),
        np.tile(placed[1], (frames, 1, 1)),
        np.tile(lens.focals[:, None], (frames, 1, 2)),
        np.tile(lens.centres, (frames, 1, 1)),
    )
    words = []
    for k in range(views):
        eye = -placed[0][k].T @ placed[1][k]
        turns = placed[0][k][None]
        if kinds[k] == HAND_HELD:
            eyes = _walked(eye, frames, fps, rng)
            turns = _aimed(eyes, points, fps, lens.sizes[k].min() / lens.focals[k], rng)
            shake = courses(frames, (3,), rng, between=SHAKES, fps=fps)
            turns = rotations_from_vectors(np.radians(rng.uniform(*SHAKE)) * shake) @ turns
        elif kinds[k] == PANNING:
            eyes = np.tile(eye, (frames, 1))
            turns = _aimed(eyes, points, fps, lens.sizes[k].min() / lens.focals[k], rng)
            if rng.random() < 0.5:
                course = np.tanh(courses(frames, (1, 1), rng, between=AIMS, fps=fps))
                cameras.focals[:, k] *= ZOOM ** (course[:, 0] / 2)
                words.append("zooming")
        elif kinds[k] == DRIFTING:
            share = np.linspace(0, 1, frames)[:, None]
            if rng.random() < 0.5:  # it sinks fast, then slowly
                share = 1 - np.exp(-4 * share)
            way, turn = rng.standard_normal((2, 3))
            eyes = eye + 0.01 * np.linalg.norm(eye) * share * way
            turn *= np.radians(log_uniform(DRIFT, rng)) / np.linalg.norm(turn)
            turns = rotations_from_vectors(share * turn) @ turns
        else:
            continue
        cameras.rotations[:, k] = turns
        cameras.translations[:, k] = -(turns @ eyes[..., None])[..., 0]
    return cameras, words


def _walked(eye: Float64, frames: int, fps: float, rng: np.random.Generator) -> Float64:
    """Return places (N, 3) of somebody who walks on an arc about the origin, and bobs."""
    pace = 1 + 0.5 * np.tanh(courses(frames, (1,), rng, between=AIMS, fps=fps)[:, 0])
    way = pace.cumsum() / pace.sum() - 0.5
    turn = np.zeros((frames, 3))
    turn[:, 2] = np.radians(rng.uniform(*ARC)) * way * rng.choice([-1, 1])
    eyes = rotations_from_vectors(turn) @ eye
    eyes *= 1 + 0.04 * courses(frames, (1,), rng, between=AIMS, fps=fps)
    bob = courses(frames, (3,), rng, between=(1.5, 2.5), fps=fps)
    return np.asarray(eyes + 0.006 * np.linalg.norm(eye) * bob * [0.3, 0.3, 1])


def _aimed(
    eyes: Float64, points: Float64, fps: float, field: float, rng: np.random.Generator
) -> Float64:
    """Return rotations (N, 3, 3) of cameras at `eyes` (N, 3) that follow the subject.

    They lag behind it, and are off by some of the `field`, the shorter side in focal lengths.
    """
    target = np.nanmean(points, 1)
    follow = 1 - np.exp(-1 / (fps * rng.uniform(*LAG)))
    for n in range(1, len(target)):
        target[n] = target[n - 1] + follow * (target[n] - target[n - 1])
    forward = target - eyes
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    look = np.stack((right, np.cross(forward, right), forward), 1)
    off = OFF * field / 2 * courses(len(eyes), (3,), rng, between=AIMS, fps=fps)
    return np.asarray(rotations_from_vectors(off) @ look)


def _crop(
    k: int, exact: Float64, cameras: _Cameras, lens: DrawnLenses, rng: np.random.Generator
) -> str:
    """Turn a view's pixels and camera into those of boxes, in place; return what was drawn."""
    side = np.array(BOXES[int(rng.integers(len(BOXES)))], np.float64)
    here = exact[:, k]  # (N, P, 2)
    blank = np.isnan(here).all((1, 2), keepdims=True)  # frames whose box is the whole image
    low = np.nanmin(np.where(blank, 0.0, here), 1)
    high = np.nanmax(np.where(blank, lens.sizes[k], here), 1)
    middle, extent = (low + high) / 2, np.maximum(high - low, 0.01 * lens.sizes[k].max())
    extent *= rng.uniform(*MARGIN)
    middle += JITTER * extent * rng.standard_normal(middle.shape)
    extent *= np.exp(JITTER * rng.standard_normal(extent.shape))
    kept, smoothed = bool(rng.random() < 0.7), bool(rng.random() < 0.5)
    if kept:
        extent = (extent / side).max(1, keepdims=True) * side
    if smoothed:
        middle, extent = _smoothed(middle), _smoothed(extent)
    scale = side / extent
    corner = middle - extent / 2
    exact[:, k] = (here - corner[:, None]) * scale[:, None]
    cameras.focals[:, k] *= scale
    cameras.centres[:, k] = (cameras.centres[:, k] - corner) * scale
    lens.sizes[k] = side
    how = "aspect kept" if kept else "stretched", *(["smoothed"] if smoothed else [])
    return f"boxes {side[0]:.0f} x {side[1]:.0f} {' '.join(how)}"


def _smoothed(series: Float64) -> Float64:
    """Means of a series (N, D) over some frames."""
    padded = np.pad(series, ((SMOOTH // 2, SMOOTH // 2), (0, 0)), mode="edge")
    means: Float64 = np.lib.stride_tricks.sliding_window_view(padded, SMOOTH, axis=0).mean(-1)
    return means
