import numpy as np
import pytest

from models.capture.synthetic import synthetic_capture
from models.capture.triangulation import triangulate


def test_exact_rays_meet_in_the_point() -> None:
    capture = synthetic_capture(frames=20, views=3, seed=1)
    found = triangulate(capture.keypoints, capture.projections)
    assert np.abs(found.points3d - capture.points3d).max() < 1e-4  # float32 pixels
    assert (found.used.sum(1) == 2).all()


def test_two_skew_rays_give_their_midpoint() -> None:
    # Cameras 1 m below and above the optical axis z, looking along z and x: by hand.
    first = np.array([[1.0, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0]])  # centre (0, -1, 0), ray +z
    turn = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # z_cam = x
    second = np.column_stack((turn, -turn @ np.array([-5.0, 3.0, 7.0])))  # ray +x at y=3, z=7
    keypoints = np.zeros((1, 2, 4, 2))
    found = triangulate(keypoints, np.stack((first, second)))
    np.testing.assert_allclose(found.points3d[0], np.tile([0.0, 1.0, 7.0], (4, 1)), atol=1e-9)


def test_an_outlier_is_dropped_and_nothing_else_matters() -> None:
    capture = synthetic_capture(frames=10, views=4, seed=2)
    keypoints = capture.keypoints.copy()
    keypoints[:, 1, 5] += 80.0
    kept = triangulate(keypoints, capture.projections, rounds=1)
    every = triangulate(keypoints, capture.projections, rounds=0)
    error = np.linalg.norm(kept.points3d - capture.points3d, axis=-1)
    before = np.linalg.norm(every.points3d - capture.points3d, axis=-1)
    # Now and then an outlier moves along its epipolar line, and another ray is the furthest.
    assert np.median(before[:, 5]) > 0.02
    assert np.median(error[:, 5]) < 1e-4
    assert not kept.used[:, 1, 5].all()
    assert np.delete(error, 5, axis=1).max() < 1e-4


def test_gaps_leave_nan_only_where_fewer_than_two_rays_remain() -> None:
    capture = synthetic_capture(frames=5, views=3, seed=3)
    keypoints = capture.keypoints.copy()
    keypoints[0, 0, 2] = np.nan  # two rays left
    keypoints[1, :2, 3] = np.nan  # one ray left
    found = triangulate(keypoints, capture.projections).points3d
    missing = np.isnan(found[..., 0])
    assert missing[1, 3]
    assert missing.sum() == 1
    assert np.abs(found[0, 2] - capture.points3d[0, 2]).max() < 1e-4


def test_parallel_rays_have_no_closest_point() -> None:
    camera = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    beside = camera + np.array([[0, 0, 0, 1.0], [0] * 4, [0] * 4])
    found = triangulate(np.zeros((1, 2, 4, 2)), np.stack((camera, beside)))
    assert np.isnan(found.points3d).all()


@pytest.mark.parametrize(
    ("projections", "rounds", "message"),
    [
        (np.zeros((3, 3, 4)), 2, "projections must have shape"),
        (np.zeros((2, 3, 4)), 2, "invertible"),
        (np.full((2, 3, 4), np.nan), 2, "finite"),
        (np.tile(np.eye(3, 4), (2, 1, 1)), -1, "rounds"),
    ],
)
def test_nonsense_is_refused(projections: np.ndarray, rounds: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        triangulate(np.zeros((1, 2, 4, 2)), projections, rounds=rounds)
