"""GIFs, by Pillow."""

from pathlib import Path

import numpy as np
import pytest
from fewview import Animation
from fewview.calibration import Camera
from fewview.errors import FormatError
from fewview.gif import write_gif
from PIL import Image, ImageSequence


@pytest.fixture
def animation() -> Animation:
    points = np.random.default_rng(0).normal(0, 0.3, (9, 4, 3)).cumsum(0)
    points[2, 1] = np.nan
    return Animation(points, fps=20, edges=((0, 1), (1, 2)))


@pytest.fixture
def cameras() -> list[Camera]:
    lens = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    resting = Camera("left", lens, rotation=np.eye(3), translation=np.array([0, 0, 9.0]))
    return [resting, Camera("moving", lens)]


def test_every_so_many_frames_in_their_own_time(
    tmp_path: Path, animation: Animation, cameras: list[Camera]
) -> None:
    seen = np.stack([cameras[0].project(animation.points)] * 2, 1)
    path = write_gif(tmp_path / "a.gif", animation, seen + 3, cameras, frames=5)
    with Image.open(path) as image:
        shown = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        assert image.info["duration"] == 100
    assert [frame.shape for frame in shown] == [(320, 640, 3)] * 5
    for part in (np.s_[:, :320], np.s_[:, 320:]):  # both panels move
        assert (shown[0][part] != shown[1][part]).any()
    red = (shown[0][..., 0] > 180) & (shown[0][..., 1] < 120)
    assert red[:, 320:].any()
    assert not red[:, :320].any()


def test_the_room_alone(tmp_path: Path, animation: Animation) -> None:
    with Image.open(write_gif(tmp_path / "a.gif", animation, up="-y")) as image:
        assert image.size == (320, 320)


def test_what_cannot_be_drawn_is_refused(
    tmp_path: Path, animation: Animation, cameras: list[Camera]
) -> None:
    with pytest.raises(ValueError, match="expected keypoints"):
        write_gif(tmp_path / "a.gif", animation, np.zeros((9, 1, 4, 2)), cameras)
    with pytest.raises(FormatError, match="ever seen"):
        write_gif(tmp_path / "a.gif", Animation(np.full((2, 1, 3), np.nan)))
