"""Two people before several cameras: who is the same in all of them."""

from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from fewview.errors import FormatError
from numpy.typing import NDArray

from tests.tiers import thorough_after

from . import files

Array = NDArray[Any]
FRAMES, POINTS = 100, 25


def bodies(rng: np.random.Generator, people: int) -> Array:
    """Return (people, frames, points, 3) metres: alike in shape, each with motions of their own."""
    common = rng.normal(0, 0.15, (POINTS, 3)) + np.linspace((0, 0, 0), (0, 0, 1.7), POINTS)
    time = np.arange(FRAMES)[:, None, None]
    out = []
    for _ in range(people):
        shape = common + rng.normal(0, 0.05, (POINTS, 3))
        sway = rng.normal(0, 0.12, (POINTS, 3))
        moved = shape + sway * np.sin(0.15 * time + rng.uniform(0, 6, (POINTS, 3)))
        turn = np.cumsum(rng.normal(0, 0.08, FRAMES))
        flat = moved[..., 0] + 1j * moved[..., 1]
        path = np.cumsum(rng.normal(0, 0.02, (FRAMES, 2)), 0) + rng.normal(0, 1.5, 2)
        flat = flat * np.exp(1j * turn)[:, None] + (path[:, 0] + 1j * path[:, 1])[:, None]
        out.append(np.stack([flat.real, flat.imag, moved[..., 2]], -1))
    return np.array(out)


def seen(points: Array, angles: Array, rng: np.random.Generator, noise: float) -> Array:
    """Return pixels (people, frames, points, 2) of a camera that looks inwards from each angle."""
    out = np.empty((*points.shape[:3], 2))
    for frame, angle in enumerate(angles):
        place = np.array([6 * np.cos(angle), 6 * np.sin(angle), 2.0])
        z = np.array([0, 0, 0.9]) - place
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        turned = (points[:, frame] - place) @ np.stack([x, np.cross(z, x), z]).T
        out[:, frame] = turned[..., :2] / turned[..., 2:] * 1100 + (960, 540)
    return out + rng.normal(0, noise, out.shape)


def capture_of(
    folder: Path, pixels: list[Array], rng: np.random.Generator, *, gone: bool = True
) -> None:
    """Write frames of OpenPose, people in any order, each away for a while in each camera."""
    for view, of_view in enumerate(pixels):
        away = rng.integers(10, FRAMES - 30, len(of_view)) if gone else [FRAMES] * len(of_view)
        frames: list[Any] = []
        for n in range(FRAMES):
            there = [k for k in range(len(of_view)) if not away[k] <= n < away[k] + 15]
            people = [
                np.concatenate([of_view[k, n], np.full((POINTS, 1), 0.9)], 1)
                for k in rng.permutation(there)
            ]
            frames.append(people)
        files.openpose(folder / f"cam{view}", frames)


def who(capture: fewview.Capture, pixels: list[Array]) -> list[set[int]]:
    """Return who each view shows, over all frames."""
    found = []
    for view, of_view in enumerate(pixels):
        off = np.abs(of_view - capture.keypoints[:, view]).mean((2, 3))
        shown = np.isfinite(off).all(0)
        found.append(set(np.argmin(off[:, shown], 0).tolist()))
    return found


@pytest.mark.parametrize(
    ("views", "noise", "moving"), thorough_after(2, [(2, 2, 0), (3, 2, 1), (3, 5, 0), (4, 2, 0)])
)
def test_the_same_person_is_taken_in_all_cameras(
    tmp_path: Path, views: int, noise: float, moving: bool
) -> None:
    rng = np.random.default_rng(views)
    points = bodies(rng, 2)
    sway = 0.3 * moving * np.sin(0.05 * np.arange(FRAMES))
    pixels = [seen(points, 0.8 * v + sway * (v + 1), rng, noise) for v in range(views)]
    capture_of(tmp_path, pixels, rng)
    first, second = fewview.read(tmp_path), fewview.read(tmp_path, person=1)
    one, other = who(first, pixels), who(second, pixels)
    assert one == [one[0]] * views
    assert other == [other[0]] * views
    assert {*one[0], *other[0]} == {0, 1}
    shown = np.isfinite(first.keypoints[..., 0, 0]).mean(0)
    assert (shown > 0.8).all()  # away for 15 of 100 frames
    assert "epipolar geometry" in first.notes[-2]
    with pytest.raises(FormatError, match="no person 9"):
        fewview.read(tmp_path, person=9)


def test_people_who_look_alike_are_noted_and_can_be_chosen(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pixels = [rng.uniform(0, 1000, (2, FRAMES, POINTS, 2)).cumsum(1) / 100 for _ in range(2)]
    for of_view in pixels:  # nothing that two cameras would see of anybody
        of_view[1] += 2000
    capture_of(tmp_path, pixels, rng, gone=False)
    capture = fewview.read(tmp_path)
    assert any("not sure" in note or "cannot be known" in note for note in capture.notes)
    chosen = [who(fewview.read(tmp_path, person=p), pixels) for p in ([0, 1], [1, 1], "1,0")]
    first = who(fewview.read(tmp_path, person=[0, 0]), pixels)
    assert chosen[0][0] == first[0]
    assert chosen[0][1] != first[1]
    assert chosen[1][0] != first[0]
    assert chosen[2][1] == first[1]
    with pytest.raises(FormatError, match="3 were named for 2 cameras"):
        fewview.read(tmp_path, person=[0, 0, 0])


def test_names_that_mean_nothing_are_seen_through(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    points = bodies(rng, 2)
    pixels = [seen(points, np.full(FRAMES, 0.8 * v), rng, 1) for v in range(3)]
    names = [f"k{k}" for k in range(POINTS)]
    for view, of_view in enumerate(pixels):
        order = [1, 0] if view == 1 else [0, 1]  # this camera gave the names the other way round
        values = np.concatenate([of_view[order], np.full((2, FRAMES, POINTS, 1), 0.9)], -1)
        values = values.transpose(1, 0, 2, 3).reshape(FRAMES, -1)
        files.dlc_csv(tmp_path / f"cam{view}.csv", files.columns(names, ("a", "b")), values)
    paths = sorted(tmp_path.iterdir())
    capture = fewview.read(paths)
    found = who(capture, pixels)
    assert found == [found[0]] * 3
    named = who(fewview.read(paths, person="a"), pixels)  # who is asked for by name is taken
    assert named == [{0}, {1}, {0}]
