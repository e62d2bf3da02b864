"""Cameras of a file, given to views."""

import numpy as np
import pytest
from fewview.calibration import Camera, as_config, for_views
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
