"""Cameras of a file, given to views."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fewview.calibration import Camera, as_config, for_views, sizes_for, write_cameras
from fewview.errors import FormatError

from models.settings.calibration import Camera as KnownCamera


def called(*names: str) -> list[Camera]:
    return [Camera(name, np.diag([100 + n, 100, 1])) for n, name in enumerate(names)]


def test_cameras_are_found_by_the_names_of_the_views() -> None:
    cameras = called("Left 1", "other", "right.1")
    found, note = for_views(cameras, ["right-1", "left_1"])
    assert found == [cameras[2], cameras[0]]
    assert "names" in note


def test_cameras_of_other_names_are_in_order() -> None:
    cameras = called("cam_0", "cam_1")
    for names in (["left", "right"], ["left", "left"]):
        found, note = for_views(cameras, names)
        assert found == cameras
        assert "order of views: cam_0, cam_1" in note


def test_cameras_named_after_images_or_videos_are_those_of_the_views() -> None:
    cameras = called("cam2.PNG", "cam1.jpeg", "cam_3.mp4")
    found, note = for_views(cameras, ["cam1", "cam2", "cam3.avi"])
    assert found == [cameras[1], cameras[0], cameras[2]]
    assert "names" in note
    unclear = called("cam2.png", "cam2.jpg")  # which names leave open
    assert for_views(unclear, ["cam1", "cam2"])[0] == unclear


def test_sizes_are_those_of_the_cameras_that_views_have(tmp_path: Path) -> None:
    sizes = [(1920, 1080), (1080, 1920)]
    cameras = [
        replace(camera, size=size)
        for camera, size in zip(called("Right.mp4", "left.mp4"), sizes, strict=True)
    ]
    file = write_cameras(tmp_path / "rig.yml", cameras)
    assert sizes_for(file, ["left", "right"]) == [(1080, 1920), (1920, 1080)]
    assert sizes_for(file, ["a", "b"]) == sizes


@pytest.mark.parametrize(
    ("cameras", "names", "message"),
    [
        (("cam_0", "cam_1"), ("a", "b", "c"), "has 2 cameras .* there are 3 views"),
        (("cam_0", "cam_1", "cam_2"), ("a", "b"), "has 3 cameras"),
        (("cam_0", "cam_1"), ("cam_0", "cam_2"), "no camera 'cam_2'"),
    ],
)
def test_what_does_not_match_is_refused(
    cameras: tuple[str, ...], names: tuple[str, ...], message: str
) -> None:
    with pytest.raises(FormatError, match=message):
        for_views(called(*cameras), names)


def test_a_camera_is_given_as_the_service_takes_it() -> None:
    lens = np.array([[900, 0, 640], [0, 910, 512], [0, 0, 1]])
    bent, there = np.array([0.1, 0.2, 0.3, 0.4]), np.array([1, 2, 3])
    fisheye = Camera("f", lens, bent, np.eye(3), there, fisheye=True)
    given = KnownCamera.model_validate(as_config(fisheye))
    assert given.intrinsics is not None
    assert given.intrinsics.model == "fisheye"
    assert given.intrinsics.distortion == (0.1, 0.2, 0.3, 0.4)
    assert (given.intrinsics.focals, given.intrinsics.centre) == ((900, 910), (640, 512))
    assert given.translation == (1, 2, 3)
    assert KnownCamera.model_validate(as_config(called("a")[0])).rotation is None
    with pytest.raises(FormatError, match="skewed"):
        as_config(Camera("s", lens + np.diag([2, 0], 1)))
