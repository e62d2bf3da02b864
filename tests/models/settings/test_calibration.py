"""Given cameras: what is accepted, what comes back, and which errors others raise."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from models.settings.calibration import Camera, Intrinsics, KnownLength
from models.settings.config import FitConfig

POSE = {"rotation": np.eye(3).tolist(), "translation": [0, 0, 4]}


def camera_with(rotation: Any) -> Camera:
    return Camera.model_validate({"rotation": rotation, "translation": [0, 0, 4]})


def test_a_focal_length_alone_is_that_of_both_axes() -> None:
    lens = Intrinsics(fx=1100)
    assert lens.focals == (1100, 1100)
    assert lens.centre is None
    assert lens.distortion is None
    assert Intrinsics(fx=1100, fy=1090).focals == (1100, 1090)


@pytest.mark.parametrize(
    "camera",
    [
        {"intrinsics": {"fx": 1100.0}},
        {"intrinsics": {"fx": 1100.0, "fy": 1090.0, "cx": 640.0, "cy": 512.0}},
        {"rotation": [0.1, 1.5, 0.0], "translation": [0.0, 1.0, 4.0]},
        {"rotation": np.eye(3).tolist(), "translation": [0.0, 1.0, 4.0]},
    ],
)
def test_what_goes_out_is_what_came_in(camera: dict[str, Any]) -> None:
    config = FitConfig.model_validate({"calibration": [camera, None]})
    assert config.model_dump(mode="json", exclude_unset=True)["calibration"] == [camera, None]
    assert FitConfig.model_validate_json(config.model_dump_json()) == config


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        ([0, 90, 0], "in radians.*degrees, multiply by pi / 180"),
        ((2 * np.eye(3)).tolist(), r"one times 2; divide by it"),
        (np.diag([1, 1, -1]).tolist(), "mirrored matrix.*OpenCV"),
        ([[1, 0, 0], [0, 1, 0], [0.5, 0, 1]], "orthonormal"),
        (np.diag([1100, 1100, 1]).tolist(), "not of a projection matrix"),
        ([1, 0, 0, 0], "3x3 matrix .* or Rodrigues' vector"),
        ([["a", 0, 0]], "3x3 matrix .* or Rodrigues' vector"),
        ([0, 0, float("nan")], "3x3 matrix .* or Rodrigues' vector"),
    ],
)
def test_a_rotation_that_is_none_is_refused_with_the_fix(rotation: Any, message: str) -> None:
    with pytest.raises(ValidationError, match=message) as refused:
        camera_with(rotation)
    (error,) = refused.value.errors()
    assert error["loc"] == ("rotation",)


def test_rounding_is_forgiven() -> None:
    turned = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]) @ np.eye(3)
    assert camera_with((turned + 1e-4).round(4).tolist()).rotation is not None


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"rotation": [0, 0, 0]}, "rotation and translation belong together"),
        ({"translation": [0, 0, 4]}, "rotation and translation belong together"),
        ({"intrinsics": {"fx": 1100, "cx": 640}}, "cx and cy belong together"),
        ({"intrinsics": {"fx": 1100, "distortion": [0.1, 0, 0]}}, r"\[0, 1, 2, 4, 5, 8\].*got 3"),
        (
            {"intrinsics": {"fx": 300, "model": "fisheye", "distortion": [0.1]}},
            r"fisheye lens.*\[0, 4\]",
        ),
    ],
)
def test_what_does_not_belong_together_is_refused(camera: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Camera.model_validate(camera)


def test_a_name_is_no_index_without_a_dataset() -> None:
    length = KnownLength.model_validate({"keypoints": ["left_knee", 4], "length": 0.4})
    with pytest.raises(ValueError, match="got the name 'left_knee'"):
        _ = length.ends
    assert length.model_copy(update={"keypoints": (3, 4)}).ends == (3, 4)
    with pytest.raises(ValueError, match="got the name 'neck'"):
        _ = FitConfig.model_validate({"handedness": [0, 1, 2, "neck"]}).corners
    assert FitConfig(handedness=(0, 1, 2, 3)).corners == (0, 1, 2, 3)
