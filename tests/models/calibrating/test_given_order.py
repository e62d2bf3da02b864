"""Poses given in another convention: against cameras that are known."""

from itertools import permutations

import numpy as np
import pytest

from models.calibrating.given_order import as_meant
from models.calibrating.image_sizes import images_of
from models.calibrating.problem import poses_of, usual_rig
from models.settings.calibration import Camera, Intrinsics
from tests.models.rigs import IMAGE_SIZE, Lens, RigCapture, make_rig_capture

GRAPHICS = np.diag([1.0, -1.0, -1.0])
AZIMUTHS = [0.0, 70.0, -130.0]  # no order of these looks like another


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    lenses = (Lens(), Lens(1300.0, distortion=(-0.2, 0.05)), Lens(900.0))
    return make_rig_capture(AZIMUTHS, lenses=lenses, noise=2.0, frames=60, seed=2)


def camera(capture: RigCapture, view: int, *, inverted: bool, graphics: bool) -> Camera:
    rotation, translation = capture.rotations[0, view], capture.translations[0, view]
    if graphics:
        rotation, translation = GRAPHICS @ rotation, GRAPHICS @ translation
    if inverted:
        rotation, translation = rotation.T, -rotation.T @ translation
    lens = capture.lenses[view]
    return Camera(
        intrinsics=Intrinsics(
            fx=lens.focal, cx=lens.centre[0], cy=lens.centre[1], distortion=lens.distortion or ()
        ),
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple(translation.tolist()),
    )


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("graphics", [False, True])
@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_poses_are_used_as_they_are_meant(
    capture: RigCapture, inverted: bool, graphics: bool, order: tuple[int, ...]
) -> None:
    given = [camera(capture, view, inverted=inverted, graphics=graphics) for view in order]
    usual = usual_rig(images_of(capture.pixels, capture.weights, [IMAGE_SIZE] * 3))
    meant, findings = as_meant(capture.pixels, capture.weights, usual, given)
    right = [camera(capture, view, inverted=False, graphics=False) for view in range(3)]
    for one, other in zip(poses_of(meant), poses_of(right), strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-9)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-9)
    assert [each and each.intrinsics for each in meant] == [each.intrinsics for each in right]
    as_given = not inverted and not graphics and order == (0, 1, 2)
    codes = [finding.code for finding in findings]
    assert codes == ([] if as_given else ["calibration_read_otherwise"])


def test_wrong_poses_that_nothing_explains_stay_as_they_are(capture: RigCapture) -> None:
    given = [camera(capture, view, inverted=False, graphics=False) for view in range(3)]
    moved = given[1].model_copy(update={"rotation": given[0].rotation})
    usual = usual_rig(images_of(capture.pixels, capture.weights, [IMAGE_SIZE] * 3))
    wrong = [given[0], moved, given[2]]
    meant, findings = as_meant(capture.pixels, capture.weights, usual, wrong)
    assert list(meant) == wrong
    assert not findings


def test_an_order_that_is_as_good_as_another_is_not_taken() -> None:
    """Three alike cameras around a room look alike, whichever comes first."""
    capture = make_rig_capture(AZIMUTHS, frames=60, seed=2)
    ring = make_rig_capture([0.0, 120.0, -120.0], frames=60, seed=2)
    usual = usual_rig(images_of(capture.pixels, capture.weights, [IMAGE_SIZE] * 3))
    given = [camera(ring, view, inverted=False, graphics=False) for view in (0, 2, 1)]
    meant, _ = as_meant(capture.pixels, capture.weights, usual, given)
    assert list(meant) == given
