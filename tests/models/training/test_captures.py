"""Real captures; they are not part of the project, so these tests skip where there are none."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.drawn_captures import draw_capture
from models.capture.metrics import pa_mpjpe
from models.capture.observations import as_observations
from models.capture.outliers import OutlierJudge, learn_outliers
from models.settings.config import FitConfig
from models.settings.keypoints import OUTLIER
from models.training.trainer import Trainer, fit

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.thorough
CAPTURES = Path(os.environ.get("FEWVIEW_CAPTURES", ROOT / "../shared/data"))


@pytest.fixture(scope="module")
def human36m() -> dict[str, NDArray[Any]]:
    path = CAPTURES / "human36m.npz"
    if not path.exists():
        pytest.skip(f"{path} is not there; set FEWVIEW_CAPTURES to the folder that holds it")
    with np.load(path) as arrays:
        return {name: arrays[name] for name in ("keypoints", "points3d")}


def test_human36m_is_lifted_to_within_20_mm_by_weak_perspective(
    human36m: dict[str, NDArray[Any]],
) -> None:
    keypoints, truth = human36m["keypoints"], human36m["points3d"]
    prior = fit(keypoints, FitConfig(steps=1000, refine="off"))
    found = prior.lift(keypoints)
    assert pa_mpjpe(found.points3d, truth, reflection="never").mean < 0.020


def test_a_twentieth_of_human36m_is_lifted_to_within_5_mm_by_perspective(
    human36m: dict[str, NDArray[Any]],
) -> None:
    keypoints, truth = human36m["keypoints"][::20], human36m["points3d"][::20]
    prior = fit(keypoints, FitConfig(steps=300))
    assert prior.cameras is not None
    assert prior.cameras.arrangement == "static"
    found = prior.lift(keypoints)
    assert pa_mpjpe(found.points3d, truth, reflection="never").mean < 0.005


def test_right_keypoints_of_few_views_are_no_outliers(human36m: dict[str, NDArray[Any]]) -> None:
    """Of three frames in five one of four views is left, of most others two."""
    keypoints = human36m["keypoints"].astype(np.float64)
    rng = np.random.default_rng(1)
    kept = rng.choice([1, 2, 3], len(keypoints), p=[0.6, 0.25, 0.15])
    order = rng.random(keypoints.shape[:2]).argsort(1).argsort(1)
    keypoints[order >= kept[:, None]] = np.nan
    seen = as_observations(keypoints)
    model = learn_outliers(seen)
    assert model is not None
    probabilities = OutlierJudge(model, range(4)).probabilities(seen)
    assert (probabilities > OUTLIER).sum() < 0.002 * np.isfinite(probabilities).sum()


@pytest.mark.parametrize("number", [45, 90])
def test_lenses_of_two_views_that_bend_inwards_are_no_fisheyes(number: int) -> None:
    """A fisheye seems likelier at first for one; for the other none can be learnt at all."""
    draw = draw_capture(number, CAPTURES)
    if draw is None:
        pytest.skip(f"{CAPTURES} does not have its motion; set FEWVIEW_CAPTURES")
    trainer = Trainer(draw.keypoints, FitConfig(), image_sizes=draw.sizes)
    next(progress for progress in trainer.run() if progress.step)
    cameras = trainer.result().cameras
    assert cameras is not None
    assert cameras.arrangement == "static"
    assert set(cameras.camera_models) == {"perspective"}
    focals = cameras.focals.mean(1)
    assert (np.abs(np.log(focals / draw.focals)) < 4 * cameras.focal_sds / focals).all()
    assert (cameras.focal_sds < 0.3 * focals).all()
