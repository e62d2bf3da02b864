"""Real captures; they are not part of the project, so these tests skip where there are none."""

import os
from pathlib import Path

import numpy as np
import pytest

from models.config import FitConfig
from models.metrics import pa_mpjpe
from models.training import fit

ROOT = Path(__file__).parents[2]
CAPTURES = Path(os.environ.get("FEWVIEW_CAPTURES", ROOT / "../shared/data"))


def test_human36m_is_lifted_to_within_20_mm_in_a_third_of_the_default_steps() -> None:
    path = CAPTURES / "human36m.npz"
    if not path.exists():
        pytest.skip(f"{path} is not there; set FEWVIEW_CAPTURES to the folder that holds it")
    with np.load(path) as arrays:
        keypoints, truth = arrays["keypoints"], arrays["points3d"]
    prior = fit(keypoints, FitConfig(steps=1000))
    found = prior.lift(keypoints)
    assert pa_mpjpe(found.points3d, truth, reflection="never").mean < 0.020
