"""Errors in the room, against a similarity and offsets that are known."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.world import angles, detected, in_room, similarity
from models.lifting.fitted_prior import FittedPrior
from models.training.trainer import fit
from tests.models.rigs import make_rig_capture
from tests.sharing import fitted_once


def test_a_similarity_is_found_and_mirrors_nothing() -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((5, 7, 3))
    turn = Rotation.random(random_state=1).as_matrix()
    truth = 2.5 * points @ turn.T + [1.0, -2.0, 3.0]
    truth[0, 0] = np.nan
    found = similarity(points, truth)
    assert np.isclose(found.scale, 2.5)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(found.of(points)[1:], truth[1:], atol=1e-12)
    mirrored = similarity(points * [1, 1, -1], truth)
    assert np.isclose(np.linalg.det(mirrored.rotation), 1)


def test_structures_stand_in_the_room_where_the_cameras_see_them() -> None:
    capture = make_rig_capture([0, 70, 140], frames=60, noise=0.2, hidden=0, seed=3)

    def make() -> FittedPrior:
        return fit(capture.keypoints, image_sizes=[(1280, 1024)] * 3)

    prior = fitted_once("room of a benchmark", make)
    cameras = prior.cameras
    assert cameras is not None
    lift = prior.lift(capture.keypoints)
    points = in_room(lift, cameras.rotations, cameras.translations)
    onto = similarity(points, capture.points3d)
    off = np.linalg.norm(onto.of(points) - capture.points3d, axis=-1)
    assert off.mean() < 0.02 * np.ptp(capture.points3d, axis=1).mean()


def test_a_detector_errs_by_as_much_as_it_is_told_and_repeats_a_part() -> None:
    errors = detected(np.zeros((4000, 2, 20, 2)), 5.0, seed=0)
    assert np.isclose(errors.std(), 5.0, rtol=0.05)
    assert np.isclose(errors.mean(0).std(), 2.5, rtol=0.15)


def test_angles_are_those_at_the_second_point() -> None:
    points = np.array([[[1.0, 0, 0], [0, 0, 0], [0, 2, 0]], [[1, 0, 0], [0, 0, 0], [1, 1, 0]]])
    np.testing.assert_allclose(angles(points), [90, 45])
