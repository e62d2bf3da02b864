"""Images upside down or mirrored: noticed by names of sides, heads and toes, and put right."""

from pathlib import Path
from typing import Any

import fewview
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from . import files

NAMES = (
    *("nose", "left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_ankle"),
    *("right_ankle", "left_heel", "right_heel", "left_big_toe", "right_big_toe"),
)
SWAPPED = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9]
# A body that faces +z, y down as in images: left is at -x.
BODY = np.array(
    [
        *([0, -1.5, 0.1], [0.2, -1.4, 0], [-0.2, -1.4, 0], [0.1, -0.9, 0], [-0.1, -0.9, 0]),
        *([0.1, -0.08, 0], [-0.1, -0.08, 0], [0.1, 0, -0.05], [-0.1, 0, -0.05]),
        *([0.12, 0, 0.18], [-0.12, 0, 0.18]),
    ]
) * [-1, 1, 1]
SIZE = (1920, 1080)


@pytest.fixture(scope="module")
def seen() -> NDArray[np.float64]:
    """Return (60, 3, 11, 2) pixels of somebody who turns round before three cameras."""
    return filmed(0.15 * np.arange(60), np.zeros(60), noise=0.03)


def filmed(
    turned: NDArray[np.floating[Any]], lifted: NDArray[np.floating[Any]], noise: float
) -> NDArray[np.float64]:
    """Return (N, 3, 11, 2) pixels of a body turned by so much (N,), its toes so much higher."""
    rng = np.random.default_rng(0)
    out = np.empty((len(turned), 3, len(NAMES), 2))
    for n, (turn, lift) in enumerate(zip(turned, lifted, strict=True)):
        body = BODY + rng.normal(0, noise, BODY.shape)
        body[-2:, 1] -= lift
        body = Rotation.from_euler("y", turn).apply(body)
        body = body + np.array([0.5 * np.sin(0.2 * n), 0, 0])
        for view in range(3):
            aside = Rotation.from_euler("y", 1.3 * view).apply(body)
            there = Rotation.from_euler("x", -15, degrees=True).apply(aside - [0, -0.9, 0])
            there = there * [-1, 1, -1] + [0, 0, 4]  # who faces +z faces the camera
            out[n, view] = there[:, :2] / there[:, 2:] * 1100 + [960, 540]
    return out


def written(folder: Path, pixels: NDArray[np.float64]) -> Path:
    folder.mkdir(exist_ok=True)
    labels, frames = files.columns(NAMES), len(pixels)
    for view in range(3):
        values = np.concatenate([pixels[:, view], np.full((frames, len(NAMES), 1), 0.9)], axis=-1)
        files.dlc_csv(folder / f"cam{view}.csv", labels, values.reshape(frames, -1))
    return folder


def notes_of(folder: Path) -> str:
    return "\n".join(fewview.read(folder).notes)


def test_images_as_cameras_see_them_are_not_doubted(
    tmp_path: Path, seen: NDArray[np.float64]
) -> None:
    assert "--y" not in notes_of(written(tmp_path, seen))
    assert "--mirror" not in notes_of(tmp_path)


@pytest.mark.parametrize(("start", "phase"), [(-3, np.pi / 2), (0, 3 * np.pi / 2)])
def test_a_step_and_a_half_is_no_evidence_of_a_mirror(
    tmp_path: Path, start: float, phase: float
) -> None:
    """Somebody turns in 40 frames, and lifts their toes as they do, by chance."""
    frames = np.arange(40)
    lifted = 0.15 * np.cos(0.2 * frames + phase)
    pixels = filmed(start + 0.08 * frames, lifted, noise=0.003)
    assert "--mirror" not in notes_of(written(tmp_path, pixels))


@pytest.mark.parametrize("exchanged", [False, True])
def test_a_mirrored_image_is_turned_and_its_names_as_the_others_say(
    tmp_path: Path, seen: NDArray[np.float64], exchanged: bool
) -> None:
    pixels = seen.copy()
    pixels[:, 1, :, 0] = SIZE[0] - 1 - pixels[:, 1, :, 0]
    if exchanged:  # a detector that saw the mirror image
        pixels[:, 1] = pixels[:, 1][:, SWAPPED]
    folder = written(tmp_path, pixels)
    assert ("--mirror cam1" in notes_of(folder)) != exchanged
    capture = fewview.read(folder, mirror="cam1", image_size=SIZE)
    np.testing.assert_allclose(capture.keypoints, seen, atol=1e-3)


def test_all_images_mirrored(tmp_path: Path, seen: NDArray[np.float64]) -> None:
    pixels = seen.copy()
    pixels[..., 0] = SIZE[0] - 1 - pixels[..., 0]
    assert "--mirror cam0,cam1,cam2" in notes_of(written(tmp_path, pixels))


def test_y_that_counts_upwards(tmp_path: Path, seen: NDArray[np.float64]) -> None:
    pixels = seen.copy()
    pixels[..., 1] = SIZE[1] - 1 - pixels[..., 1]
    folder = written(tmp_path / "up", pixels)
    assert "--y up" in notes_of(folder)
    capture = fewview.read(folder, y="up", image_size=SIZE)
    np.testing.assert_allclose(capture.keypoints, seen, atol=1e-3)
    assert "--y up" not in "\n".join(capture.notes)
    one = seen.copy()
    one[:, 2, :, 1] = SIZE[1] - 1 - one[:, 2, :, 1]
    assert "cam2: heads are below the feet" in notes_of(written(tmp_path / "one", one))
