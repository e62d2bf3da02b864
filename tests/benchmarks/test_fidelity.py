"""What spoils keypoints in the benchmark of fidelity, and how found outliers are counted."""

import numpy as np

from benchmarks.report import precision_and_recall
from benchmarks.rig import scatter


def test_a_share_of_the_keypoints_lies_anywhere_in_the_image() -> None:
    keypoints = np.full((500, 2, 8, 2), 100.0)
    keypoints[:, 1, 3] = np.nan
    sizes = [(640, 480), (1280, 1024)]
    spoilt, placed = scatter(keypoints, 0.2, sizes, seed=0)
    np.testing.assert_array_equal(spoilt[~placed], keypoints[~placed])
    assert not placed[:, 1, 3].any()
    assert abs(placed.sum() / (500 * 15) - 0.2) < 0.02
    for view, size in enumerate(sizes):
        anywhere = spoilt[:, view][placed[:, view]] / size
        assert anywhere.min() >= 0
        assert anywhere.max() < 1
        np.testing.assert_allclose(anywhere.mean(0), 0.5, atol=0.05)
    # Without a size, an image reaches as far as its keypoints.
    assert np.nanmax(scatter(keypoints, 0.2, None, seed=0)[0]) <= 100


def test_precision_and_recall_are_counted() -> None:
    planted = np.array([[[True, True, False, False, False]]])
    probability = np.array([[[0.9, 0.1, 0.8, 0.7, np.nan]]])
    assert precision_and_recall(probability, planted) == (1 / 3, 1 / 2)
