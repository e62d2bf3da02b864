"""Essential matrices against cameras that are known exactly."""

import numpy as np

from models.epipolar.essential import decompose, five_point
from models.numerics.rotations import rotations_from_vectors


def test_five_points_give_the_true_pose_among_few() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal((0, 0, 4), 0.8, (400, 3))
    rotation = rotations_from_vectors(np.array([0.1, 1.2, -0.2]))
    translation = np.array([-4.0, 0.3, 3.0]) / 5
    moved = points @ rotation.T + 5 * translation
    x, y = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    samples = rng.permutation(400).reshape(80, 5)
    found = five_point(x[samples], y[samples])
    assert len(found.matrices) <= 10 * len(samples)
    rotations, translations = decompose(found.matrices)
    assert np.allclose(np.linalg.det(rotations), 1)
    off = np.abs(rotations - rotation).max((2, 3))
    unit = translation / np.linalg.norm(translation)
    off = np.maximum(off, np.abs(translations - unit).max(2))  # (H, 4)
    best = np.full(len(samples), np.inf)
    np.minimum.at(best, found.samples, off.min(1))
    assert (best < 1e-4).mean() > 0.95
