"""Cameras against a calibration, with errors that are known beforehand."""

from dataclasses import replace

import numpy as np
import pytest
from fewview.calibration import Camera, compare_cameras, rotation_matrix
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def rig() -> list[Camera]:
    lens = np.array([[1100.0, 0, 640], [0, 1090, 512], [0, 0, 1]])
    bent = np.array([-0.2, 0.05, 0.001, -0.001])
    turns = [rotation_matrix([0.1 * k, 1.2 * k, -0.05]) for k in range(3)]
    places = np.array([[0.1, 0.2, 4], [-0.3, 0, 4.5], [0.2, -0.1, 5]])
    return [Camera(f"c{k}", lens, bent, turns[k], places[k]) for k in range(3)]


def elsewhere(cameras: list[Camera]) -> list[Camera]:
    """Return the same rig in another room of another unit."""
    turn, shift, scale = rotation_matrix([0.4, -0.9, 2.0]), np.array([3.0, -1, 7]), 0.01
    moved = []
    for camera in cameras:
        assert camera.rotation is not None
        assert camera.translation is not None
        rotation = camera.rotation @ turn.T
        place = scale * (camera.translation - rotation @ shift)
        moved.append(replace(camera, rotation=rotation, translation=place))
    return moved


def test_a_rig_in_another_room_and_unit_is_the_same() -> None:
    for error in compare_cameras(elsewhere(rig()), rig()):
        assert error.rotation == pytest.approx(0, abs=1e-6)
        assert error.centre == pytest.approx(0, abs=1e-9)
        assert error.direction == pytest.approx(0, abs=1e-6)
        assert error.focal == pytest.approx((0, 0))
        assert error.principal_point == 0


def test_errors_are_degrees_units_and_per_cent() -> None:
    # Two cameras that each turn by 3 degrees about their own axes, one to each side.
    found = elsewhere(rig())
    for k, sign in ((1, 1), (2, -1)):
        rotation, place = found[k].rotation, found[k].translation
        assert rotation is not None
        assert place is not None
        turn = rotation_matrix([0, 0, sign * np.radians(3)])
        found[k] = replace(
            found[k],
            rotation=turn @ rotation,
            translation=turn @ place,
        )
    lens = np.array([[1155.0, 0, 643], [0, 1090, 508], [0, 0, 1]])
    found[0] = replace(found[0], matrix=lens)
    errors = compare_cameras(found, rig())
    assert [error.name for error in errors] == ["c0", "c1", "c2"]
    assert sum(error.rotation or 0 for error in errors) == pytest.approx(6, abs=1.2)
    assert errors[0].focal == pytest.approx((5, 0))
    assert errors[0].principal_point == pytest.approx(5)
    assert all((error.centre or 0) > 0.01 for error in errors)


def test_a_camera_without_a_pose_is_compared_by_its_lens() -> None:
    found = elsewhere(rig())
    found[1] = replace(found[1], rotation=None, translation=None)
    errors = compare_cameras(found, rig())
    assert (errors[1].rotation, errors[1].centre, errors[1].direction) == (None, None, None)
    assert errors[1].focal == pytest.approx((0, 0))
    assert errors[2].rotation == pytest.approx(0, abs=1e-6)
    alone = compare_cameras(found[:1], rig()[:1])
    assert alone[0].rotation is None
    with pytest.raises(ValueError, match="expected 3 cameras"):
        compare_cameras(found[:2], rig())


@pytest.mark.parametrize("fisheye", [False, True])
def test_pixels_are_straightened(fisheye: bool) -> None:
    camera = replace(rig()[1], fisheye=fisheye, distortion=np.array([-0.08, 0.02, 1e-3, -5e-4]))
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (40, 3))
    eye = replace(camera, rotation=None, translation=None)
    directions = eye.straighten(eye.project(points))
    np.testing.assert_allclose(directions, points[:, :2] / points[:, 2:], atol=1e-6)
    assert np.isnan(camera.straighten([np.nan, 3.0])).all()
