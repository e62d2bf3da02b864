"""Triangulation under Student's t, against points that are known."""

import numpy as np

from models.epipolar.robust_points import robust_points
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from tests.models.rigs import around


def test_a_wrong_ray_of_four_does_not_move_a_point() -> None:
    rng = np.random.default_rng(0)
    rotations, translations = around([0.0, 60.0, 120.0, -100.0])
    rig = StaticCameras(
        np.zeros(4), np.zeros((4, 2)), np.full((4, 2), -0.05), rotations, translations
    )
    points = rng.uniform(-0.5, 0.5, (3, 500))
    camera = rotations @ points + translations[..., None]
    flat = camera[:, :2] / camera[:, 2:]
    squared = np.square(flat).sum(1, keepdims=True)
    images = flat * (1 - 0.05 * squared - 0.05 * squared**2)
    wrong = rng.integers(4, size=500)
    images[wrong, :, np.arange(500)] += rng.uniform(0.1, 0.4, (500, 2))
    weights = np.ones((4, 500))
    found = robust_points(rig, SeenPoints(images, weights), np.full(4, 1e-3))
    assert np.linalg.norm(found - points, axis=0).max() < 1e-3
    # Without the wrong rays they are where the others meet, to the last digit.
    weights[wrong, np.arange(500)] = 0
    found = robust_points(rig, SeenPoints(images, weights), np.full(4, 1e-3))
    assert np.linalg.norm(found - points, axis=0).max() < 1e-7


def test_points_that_some_views_do_not_see_spoil_no_other() -> None:
    """Of three views some points lack one; of the others, some have a ray that is far off."""
    rng = np.random.default_rng(1)
    rotations, translations = around([0.0, 60.0, 120.0])
    rig = StaticCameras(np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)), rotations, translations)
    points = rng.uniform(-0.5, 0.5, (3, 400))
    camera = rotations @ points + translations[..., None]
    images, weights = camera[:, :2] / camera[:, 2:], np.ones((3, 400))
    weights[np.arange(0, 400, 4) % 3, np.arange(0, 400, 4)] = 0
    images += 0.002 * rng.standard_normal(images.shape)
    harmed = np.arange(1, 400, 20)
    images[harmed % 3, :, harmed] += rng.uniform(-0.6, 0.6, (20, 2))
    found = robust_points(rig, SeenPoints(images, weights), np.full(3, 2e-3))
    assert np.linalg.norm(found - points, axis=0)[harmed].max() < 0.1
