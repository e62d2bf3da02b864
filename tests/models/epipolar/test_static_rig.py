"""Static rigs from keypoints alone, against cameras that are known exactly."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.epipolar.pairs import Beliefs
from models.epipolar.static_rig import Geometry, StaticRig, find_static_rig
from models.numerics.steps import finished
from tests.models.rigs import IMAGE_SIZE, Lens, RigCapture, make_rig_capture

Float64 = NDArray[np.float64]

SIDE = max(IMAGE_SIZE)
UNLIKE = (Lens(focal=700), Lens(focal=1300), Lens(focal=2000))


def found_in(capture: RigCapture) -> StaticRig | None:
    return geometry_in(capture).rig


def geometry_in(capture: RigCapture) -> Geometry:
    views = len(capture.lenses)
    centres = np.array(IMAGE_SIZE) / 2
    radii = capture.pixels - capture.pixels.mean(2, keepdims=True)
    sizes = np.sqrt(np.square(radii).sum(-1).mean((0, 2))) / SIDE
    believed = Beliefs(
        np.full(views, 1.2),
        0.5**2 * np.eye(views),
        0.02**2 * np.eye(views),
        np.stack((0.2**2 + 0.05**2 * np.eye(views), 0.07**2 + 0.01**2 * np.eye(views))),
    )
    images = (capture.pixels - centres) / SIDE
    return finished(find_static_rig(images, capture.weights, believed, sizes))


def rotation_errors(capture: RigCapture, found: StaticRig, views: list[int]) -> Float64:
    """Degrees, of every rotation from the first of some views to another."""
    first = views[0]
    ours = found.best.rig.rotations[views[1:]] @ found.best.rig.rotations[first].T
    truth = capture.rotations[0, views[1:]] @ capture.rotations[0, first].T
    cosines = (np.trace(ours @ truth.mT, axis1=1, axis2=2) - 1) / 2
    return np.asarray(np.degrees(np.arccos(cosines.clip(-1, 1))))


def test_unlike_lenses_and_the_right_hand_are_found() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=80, lenses=UNLIKE, noise=1.0)
    found = found_in(capture)
    assert found is not None
    assert found.static.all()
    focals = SIDE * np.exp(found.best.rig.log_focals)
    np.testing.assert_allclose(focals, [lens.focal for lens in UNLIKE], rtol=0.04)
    assert rotation_errors(capture, found, [0, 1, 2]).max() < 2
    assert found.noise * SIDE < 2
    # Every frame speaks for the rig and against its mirror image, or nearly.
    assert (found.log_odds > 0).mean() > 0.9


def test_outliers_and_gaps_do_no_harm() -> None:
    capture = make_rig_capture([0.0, 70.0, 150.0, -100.0], frames=60, hidden=0.3)
    rng = np.random.default_rng(1)
    stray = rng.random(capture.keypoints.shape[:3]) < 0.15
    capture.keypoints[stray] += 120 * rng.standard_normal((int(stray.sum()), 2))
    found = found_in(capture)
    assert found is not None
    assert found.static.all()
    assert rotation_errors(capture, found, [0, 1, 2, 3]).max() < 2
    several = np.isfinite(capture.keypoints).all(-1).sum(1) >= 2
    assert np.isfinite(found.best.points[several]).all()
    assert np.isnan(found.best.points[~several]).all()


def test_a_view_that_moves_does_not_spoil_the_others() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0, 170.0], frames=60, moving=(1,))
    found = found_in(capture)
    assert found is not None
    assert found.static.tolist() == [True, False, True, True]
    assert rotation_errors(capture, found, [0, 2, 3]).max() < 2
    assert np.isnan(found.best.rig.rotations[1]).all()


def test_no_camera_is_static_where_all_move() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=60, moving=(0, 1, 2))
    found = found_in(capture)
    # A pair can always be made to agree halfway; three views cannot.
    assert found is None or (found.static.sum() == 2 and found.noise * SIDE > 5)


def test_two_views_that_move_are_no_rig() -> None:
    """One rigid scene would explain them to 37 px."""
    assert found_in(make_rig_capture([0.0, 80.0], frames=60, moving=(0, 1))) is None
    static = found_in(make_rig_capture([0.0, 80.0], frames=60))
    assert static is not None
    assert static.static.all()


def test_certain_motion_is_seen_in_pairs_and_noise_is_no_motion() -> None:
    angles = [0.0, 80.0, -120.0]
    assert geometry_in(make_rig_capture(angles, frames=60, moving=(0, 1, 2))).moves
    assert geometry_in(make_rig_capture(angles, frames=60, moving=(1,), noise=3.0)).moves
    for noise in (0.0, 25.0):
        assert not geometry_in(make_rig_capture(angles, frames=60, noise=noise)).moves


def test_clear_keypoints_give_exact_cameras() -> None:
    capture = make_rig_capture([0.0, 50.0, 110.0], frames=80, lenses=UNLIKE, noise=0.0)
    found = found_in(capture)
    assert found is not None
    focals = SIDE * np.exp(found.best.rig.log_focals)
    np.testing.assert_allclose(focals, [lens.focal for lens in UNLIKE], rtol=5e-3)
    assert rotation_errors(capture, found, [0, 1, 2]).max() < 0.2


@pytest.mark.thorough
def test_motion_beyond_noise_is_seen() -> None:
    """Cameras that shake are distinguished from static ones with noisy keypoints."""
    static = found_in(make_rig_capture([0.0, 80.0, -120.0], frames=60, noise=6.0))
    assert static is not None
    assert (static.motion.gains < 0).all()
    shaken = make_rig_capture([0.0, 80.0, -120.0], frames=60, noise=1.0)
    rng = np.random.default_rng(3)
    shaken.keypoints[...] += 15 * rng.standard_normal((60, 3, 1, 2))  # each image as a whole
    moving = found_in(shaken)
    assert moving is None or moving.static.sum() == 2


@pytest.mark.thorough
def test_equal_keypoints_give_equal_rigs() -> None:
    capture = make_rig_capture([0.0, 80.0], frames=40)
    first, second = found_in(capture), found_in(capture)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.best.rig.rotations, second.best.rig.rotations)
    np.testing.assert_array_equal(first.best.rig.log_focals, second.best.rig.log_focals)
