"""What keypoints say of the images that they come from."""

import numpy as np
import pytest

from models.calibrating.image_sizes import images_of

FRAMES, POINTS = 200, 10


def test_a_given_size_is_used_and_a_guess_holds_all_keypoints() -> None:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform((300, 200), (900, 850), (FRAMES, 2, POINTS, 2))
    keypoints[0, 1, 0] = 40_000  # astray
    images = images_of(keypoints, np.ones(keypoints.shape[:3]), [(1280, 1024), None])
    assert images.known.tolist() == [True, False]
    assert images.sizes[0].tolist() == [1280, 1024]
    assert images.middles[0].tolist() == [640, 512]
    # As far from the right as from the left.
    np.testing.assert_allclose(images.sizes[1], (1200, 1050), rtol=0.01)
    np.testing.assert_allclose(images.middles[1], (600, 525), rtol=0.01)
    assert images.side == images.sizes.max()


def test_all_images_of_unknown_size_have_one_size() -> None:
    rng = np.random.default_rng(0)
    keypoints = rng.uniform((100, 100), (500, 400), (FRAMES, 2, POINTS, 2))
    keypoints[:, 1] += 200
    images = images_of(keypoints, np.ones(keypoints.shape[:3]), None)
    np.testing.assert_allclose(images.sizes, [(800, 700)] * 2, rtol=0.02)


@pytest.mark.parametrize("shift", [-1000.0, -300.0])
def test_an_origin_that_is_no_corner_is_noticed(shift: float) -> None:
    rng = np.random.default_rng(0)
    keypoints = shift + rng.uniform(0, 600, (FRAMES, 2, POINTS, 2))
    images = images_of(keypoints, np.ones(keypoints.shape[:3]), None)
    np.testing.assert_allclose(images.sizes, 600, rtol=0.02)
    np.testing.assert_allclose(images.middles, shift + 300, atol=10)


def test_what_is_not_seen_does_not_count() -> None:
    keypoints = np.full((FRAMES, 1, POINTS, 2), 1e6)
    images = images_of(keypoints, np.zeros(keypoints.shape[:3]), None)
    assert np.isfinite(images.middles).all()
    assert 0 < images.side < 10
