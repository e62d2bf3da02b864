"""How far a camera may move, as a share of the subject's size, before it counts as moving.

A camera swings between two poses, so that each frame shows as much of its motion as any other.
"""

import numpy as np
import pytest

from models.epipolar.static_rig import StaticRig
from tests.models.epipolar.test_static_rig import found_in
from tests.models.rigs import RigCapture, make_rig_capture

PAIR, THREE = [0.0, 80.0], [0.0, 80.0, -120.0]
SWINGING = 1  # the view that moves


def capture_of(azimuths: list[float], frames: int, noise: float) -> RigCapture:
    return make_rig_capture(azimuths, frames=frames, noise=noise, hidden=0.0)


def shaken(share: float, frames: int, moving: slice = slice(None)) -> StaticRig | None:
    """Find the rig of three views, one image shifted by this share of the subject's size."""
    capture = capture_of(THREE, frames, noise=0.3)
    images = capture.keypoints[:, SWINGING]
    size = np.sqrt(np.square(images - images.mean(1, keepdims=True)).sum(-1).mean())
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, frames)
    shifts = share * size * np.stack((np.cos(angles), np.sin(angles)), -1)
    images[moving] += shifts[moving, None]
    return found_in(capture)


def swinging(share: float, noise: float) -> StaticRig | None:
    """Find the rig of two views, one nearer and farther by this share of its distance."""
    capture = capture_of(PAIR, 40, noise)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], 40)
    images = capture.keypoints[:, SWINGING]
    middles = images.mean(1, keepdims=True)
    images[...] = middles + np.exp(share * signs)[:, None, None] * (images - middles)
    return found_in(capture)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_two_views_are_static_with_errors_that_repeat_within_frames(noise: float) -> None:
    """Poses of their own certainly predict keypoints better, but by too little."""
    found = swinging(0.02, noise)
    assert found is not None
    assert found.static.all()
    assert (found.motion.gains > 4 * found.motion.errors).all()


def test_two_views_are_no_rig_if_one_goes_nearer_and_farther() -> None:
    assert swinging(0.2, 1.0) is None


def test_a_percent_of_the_subject_is_no_motion() -> None:
    found = shaken(0.01, 40)
    assert found is not None
    assert found.static.all()
    assert found.motion.gains[SWINGING] > 4 * found.motion.errors[SWINGING]


def test_four_percent_of_the_subject_are_motion_among_three_views() -> None:
    found = shaken(0.04, 24)
    assert found is not None
    assert found.static.sum() == 2


def test_one_frame_is_no_evidence_of_motion() -> None:
    """The other frames' keypoints are predicted no better, however far the camera jumped."""
    found = shaken(0.25, 24, moving=slice(3, 4))
    assert found is not None
    assert found.static.all()
    assert found.motion.gains[SWINGING] < 3 * found.motion.errors[SWINGING]
