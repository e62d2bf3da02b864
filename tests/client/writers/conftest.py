"""A short animation with gaps, for all formats."""

import numpy as np
import pytest
from fewview import Animation


@pytest.fixture
def animation() -> Animation:
    """Return five keypoints that form a tree; one is missing at times, one always."""
    points = np.random.default_rng(4).normal(size=(12, 5, 3)).cumsum(0)
    points[3:5, 2] = np.nan
    points[0, 2, 1] = np.inf
    points[:, 4] = np.nan
    return Animation(
        points,
        unit="m",
        fps=25,
        keypoint_names=("nose", "left hip", "knee é", "foot", "tail"),
        edges=((0, 1), (1, 2), (3, 2), (1, 4)),
    )
