"""A short animation with gaps, for all formats."""

from dataclasses import replace

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


@pytest.fixture
def doubted(animation: Animation) -> Animation:
    """Return the animation with how far its points may be off; of a point of it that is unknown."""
    sds = np.random.default_rng(5).uniform(1e-3, 0.3, animation.seen.shape)
    sds[~animation.seen] = np.nan
    sds[7, 1] = np.nan
    return replace(animation, points_sd=sds)
