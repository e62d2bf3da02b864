"""Plants faults in captures and tests whether the checks before a fit find them.

python benchmarks/harms.py CAPTURE.npz ... --cases 20

A case is a fault of random size at a random place, with noise of 0 to 15 pixels, outliers or gaps;
one in five has only two of the views. No fit is made. Left and right are found from names of
keypoints, which are read from `keypoint_names` in the file or from `keypoint_names` or
`joint_names` in the .json file beside it; without names left and right are not exchanged.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.findings.finding import Finding
from models.numerics.rotations import rotations_from_vectors
from models.settings.config import FitConfig
from models.training.keypoints_of_fit import observe
from models.training.synchronising import put_in_step

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Rng = np.random.Generator

# Noise in pixels, share of outliers, share of gaps: taken in turns.
AS_THEY_ARE = FitConfig(outlier_rejection=False, denoising=False)
SPOILT = ((0, 0, 0), (2, 0, 0), (5, 0, 0), (15, 0, 0), (5, 0.1, 0.3), (8, 0.1, 0))
SAME_FRAMES = 0.97  # of all frames that must be classified correctly
SIDES = (("left", "right"), ("l", "r"))  # what a name begins or ends with
JOINED = 100  # ranges: a finding that lists so many has joined some of them


class Planted(NamedTuple):
    """Keypoints with a harm, and what a finding of it must name."""

    keypoints: Float64  # (N, K, P, 2)
    views: tuple[int, ...] = ()
    frames: Bool | None = None  # (N,); None: not asked
    order_noise: bool = True  # whether noise is added after the harm


def swapped(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Exchange two views in a run of frames, or here and there."""
    a, b = sorted(rng.choice(k.shape[1], 2, replace=False).tolist())
    frames = _run(rng, len(k), rng.uniform(0.05, 0.45))
    if rng.random() < 1 / 3:
        frames = rng.random(len(k)) < rng.uniform(0.05, 0.45)
    k[frames, a], k[frames, b] = k[frames, b].copy(), k[frames, a].copy()
    return Planted(k, (a, b), frames)


def sided(k: Float64, rng: Rng, partners: NDArray[np.intp]) -> Planted:
    """Exchange left and right of a view in all frames, or in a run."""
    view = int(rng.integers(k.shape[1]))
    whole = rng.random() < 0.5
    frames = np.ones(len(k), np.bool_) if whole else _run(rng, len(k), rng.uniform(0.1, 0.6))
    k[frames, view] = k[frames, view][:, partners]
    return Planted(k, (view,), frames)


def bumped(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Turn a camera by 1 to 10 degrees about any axis, from a frame on."""
    view, first = int(rng.integers(k.shape[1])), int(rng.uniform(0.2, 0.8) * len(k))
    low, high = np.nanmin(k[:, view], (0, 1)), np.nanmax(k[:, view], (0, 1))
    middle, focal = (low + high) / 2, 1.5 * float((high - low).max())
    axis = rng.standard_normal(3)
    vector = np.radians(10 ** rng.uniform(0, 1)) * axis / np.linalg.norm(axis)
    flat = (k[first:, view] - middle) / focal
    rays = np.concatenate((flat, np.ones((*flat.shape[:-1], 1))), -1)
    turned = rays @ rotations_from_vectors(vector).T
    k[first:, view] = turned[..., :2] / turned[..., 2:] * focal + middle
    return Planted(k, (view,), np.arange(len(k)) >= first)


def frozen(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Let a keypoint of a view stand still."""
    view = int(rng.integers(k.shape[1]))
    k[:, view, rng.integers(k.shape[2])] = rng.uniform(0, 100, 2)
    return Planted(k, (view,), order_noise=False)


def never_seen(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Hide a keypoint from all views."""
    k[:, :, rng.integers(k.shape[2])] = np.nan
    return Planted(k)


def identical(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Let a view be a copy of another."""
    a, b = rng.choice(k.shape[1], 2, replace=False).tolist()
    k[:, b] = k[:, a]
    return Planted(k, tuple(sorted((a, b))), order_noise=False)


def normalised(k: Float64, _: Rng, __: NDArray[np.intp]) -> Planted:
    """Divide by a size of the image."""
    return Planted(k / np.nanmax(k), order_noise=False)


def one_view(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Hide all views but one."""
    hidden = np.arange(k.shape[1]) != rng.integers(k.shape[1])
    k[:, hidden] = np.nan
    return Planted(k)


def few_frames(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Keep 5 to 25 frames."""
    return Planted(k[rng.choice(len(k), int(rng.integers(5, 26)), replace=False)])


def motionless(k: Float64, rng: Rng, _: NDArray[np.intp]) -> Planted:
    """Repeat one frame."""
    return Planted(np.repeat(k[[rng.integers(len(k))]], len(k), 0))


def unharmed(k: Float64, _: Rng, __: NDArray[np.intp]) -> Planted:
    """Leave the capture as it is."""
    return Planted(k)


HARMS: dict[str, Callable[[Float64, Rng, NDArray[np.intp]], Planted]] = {
    "unharmed": unharmed,
    "views_swapped": swapped,
    "left_right_swapped": sided,
    "camera_moved": bumped,
    "keypoint_frozen": frozen,
    "keypoint_never_seen": never_seen,
    "views_identical": identical,
    "coordinates_normalised": normalised,
    "one_view": one_view,
    "too_few_frames": few_frames,
    "no_motion": motionless,
}


class Score(NamedTuple):
    """The result of one case."""

    found: bool
    views: bool
    frames: bool
    others: tuple[str, ...]  # warnings of other codes


def judge(code: str, planted: Planted, findings: tuple[Finding, ...]) -> Score:
    """Return whether a harm was found, and where it is."""
    warnings = [finding for finding in findings if finding.severity == "warning"]
    others = tuple(finding.code for finding in warnings if finding.code != code)
    mine = [finding for finding in findings if finding.code == code]
    if not mine:
        return Score(False, False, False, others)
    views, pair = set(mine[0].views), planted.keypoints.shape[1] == 2
    right_views = views == set(planted.views) or (not views and pair)
    where = not planted.views or right_views or (pair and views == {0, 1})
    when = True
    if planted.frames is not None and len(mine[0].frames) < JOINED:
        marked = np.zeros(len(planted.frames), np.bool_)
        for first, last in mine[0].frames or ((0, len(marked) - 1),):
            marked[first : last + 1] = True
        when = bool((marked == planted.frames).mean() >= SAME_FRAMES)
    return Score(True, where, when, others)


def partners_by_name(names: Sequence[str]) -> NDArray[np.intp]:
    """Return with which keypoint each changes places by name: left_hip, RKnee, wrist_l, hip.L."""
    places = {name.lower(): number for number, name in enumerate(names)}
    partners = np.arange(len(names))
    for name, number in places.items():
        for other in _mirrored(name):
            if other in places:
                partners[number], partners[places[other]] = places[other], number
    return partners


def _mirrored(name: str) -> Iterator[str]:
    """Yield a name with the side exchanged that it begins or ends with."""
    for one, other in (*SIDES, *(side[::-1] for side in SIDES)):
        if name.startswith(one):
            yield other + name[len(one) :]
        if name.endswith(one):
            yield name[: -len(one)] + other


def run_case(code: str, keypoints: Float64, names: list[str] | None, case: int) -> Score | None:
    """Plant a harm and ask for the findings; None if the capture cannot have the harm."""
    rng = np.random.default_rng([case, sorted(HARMS).index(code)])
    partners = np.arange(keypoints.shape[2]) if names is None else partners_by_name(names)
    if code == "left_right_swapped" and (partners == np.arange(len(partners))).all():
        return None
    k = keypoints.copy()
    if case % 5 == 4:
        k = k[:, np.sort(rng.choice(k.shape[1], 2, replace=False))]
    planted = HARMS[code](k, rng, partners)
    k = _spoil(planted.keypoints, SPOILT[case % len(SPOILT)] if planted.order_noise else None, rng)
    read = put_in_step(k.astype(np.float32), None, None, "auto")
    return judge(code, planted, observe(read, None, None, AS_THEY_ARE).capture.findings)


def main() -> None:
    """Print a row for each capture and harm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=list(HARMS), default=list(HARMS))
    arguments = parser.parse_args()
    out = sys.stdout
    out.write("| capture | harm | cases | found | views | frames | other warnings |\n")
    out.write("|---|---|---|---|---|---|---|\n")
    for path in arguments.captures:
        with np.load(path) as file:
            keypoints = file["keypoints"].astype(np.float64)
        names = keypoint_names(path)
        for code in arguments.only:
            tried = [run_case(code, keypoints, names, case) for case in range(arguments.cases)]
            scores = [score for score in tried if score is not None]
            found, views, frames = (
                sum(getattr(score, name) for score in scores) for name in Score._fields[:3]
            )
            others = sorted(other for score in scores for other in score.others)
            counted = ", ".join(f"{others.count(o)} {o}" for o in sorted(set(others)))
            cells = (path.stem, code, len(scores), found, views, frames, counted)
            out.write("| " + " | ".join(map(str, cells)) + " |\n")
            out.flush()


def _run(rng: Rng, frames: int, share: float) -> Bool:
    length = max(2, int(share * frames))
    first = int(rng.integers(0, frames - length + 1))
    mask = np.zeros(frames, np.bool_)
    mask[first : first + length] = True
    return mask


def _spoil(k: Float64, how: tuple[float, float, float] | None, rng: Rng) -> Float64:
    if how is None:
        return k
    noise, outliers, gaps = how
    low, high = np.nanmin(k, (0, 1, 2)), np.nanmax(k, (0, 1, 2))
    k = k + noise * rng.standard_normal(k.shape)
    astray = (rng.random(k.shape[:3]) < outliers) & np.isfinite(k).all(-1)
    k[astray] = rng.uniform(low, high, (int(astray.sum()), 2))
    k[rng.random(k.shape[:3]) < gaps] = np.nan
    return k


def keypoint_names(path: Path) -> list[str] | None:
    """Return the names in a capture's file or in the JSON beside it; None if neither has any."""
    with np.load(path) as file:
        names = file["keypoint_names"].tolist() if "keypoint_names" in file else None
    beside = path.with_suffix(".json")
    if names is None and beside.exists():
        fields = json.loads(beside.read_text())
        names = fields.get("keypoint_names") or fields.get("joint_names")
    return names


if __name__ == "__main__":
    main()
