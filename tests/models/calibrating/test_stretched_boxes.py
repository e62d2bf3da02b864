"""Images of a detector's boxes that are resized to one shape: each is stretched in its own way."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.capture.boxes import boxes_of
from models.capture.metrics import pa_mpjpe
from models.capture.synthetic import synthetic_capture
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.settings.config import FitConfig
from models.training.trainer import fit

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

FRAMES, VIEWS, VIEW, SIDE = 60, 4, 1, 256.0


def boxed(seed: int = 0) -> tuple[Float64, Float32, Float64]:
    """Return keypoints (N, K, P, 2), one view in boxes; true points; its factor x over y (N,)."""
    capture = synthetic_capture(frames=FRAMES, views=VIEWS, seed=seed)
    keypoints = capture.keypoints.astype(np.float64)
    low, high = keypoints[:, VIEW].min(1), keypoints[:, VIEW].max(1)
    margin = 1.2 * np.exp(0.03 * np.random.default_rng(seed).standard_normal((FRAMES, 2)))
    scale = SIDE / (margin * (high - low))
    away = keypoints[:, VIEW] - (low + high)[:, None] / 2
    keypoints[:, VIEW] = scale[:, None] * away + SIDE / 2
    return keypoints, capture.points3d, scale[:, 0] / scale[:, 1]


@pytest.fixture(scope="module")
def fitted() -> FittedPrior:
    return fit(boxed()[0], FitConfig(steps=150, dictionary_sizes=(64, 16), cameras="moving"))


def test_the_view_in_boxes_is_found_and_no_other() -> None:
    keypoints, _, _ = boxed()
    seen = np.ones(keypoints.shape[:3])
    found = boxes_of(keypoints, seen)
    assert found.shown.tolist() == found.stretched.tolist() == [False, True, False, False]
    seen[:, :, 3] = 0
    keypoints[:, :, 3] = 1e5  # not observed
    assert boxes_of(keypoints, seen).stretched[VIEW]


def test_boxes_that_keep_the_aspect_are_not_stretched() -> None:
    keypoints, _, ratios = boxed()
    middle = SIDE / 2
    keypoints[:, VIEW, :, 0] = middle + (keypoints[:, VIEW, :, 0] - middle) / ratios[:, None]
    found = boxes_of(keypoints, np.ones(keypoints.shape[:3]))
    assert found.shown.tolist() == [False, True, False, False]
    assert not found.stretched.any()


def test_structures_are_as_true_as_without_boxes(fitted: FittedPrior) -> None:
    keypoints, points, ratios = boxed()
    lift = fitted.lift(keypoints)
    errors = pa_mpjpe(lift.points3d, points, reflection="never").errors.mean(1)
    height = np.ptp(points[..., 1], axis=1).mean()
    assert np.median(errors) < 0.005 * height  # a network of 150 steps mirrors some frames
    assert np.median(lift.reprojection_errors[:, VIEW]) < 0.005 * SIDE
    assert np.median(off(lift, ratios)) < 0.05
    turned = lift.rotations @ lift.rotations.mT
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-5)


def test_new_frames_have_a_stretch_of_their_own(fitted: FittedPrior) -> None:
    keypoints, _, ratios = boxed(seed=7)
    again = FittedPrior.from_bytes(fitted.to_bytes())
    lift = again.lift(keypoints)
    assert np.log(ratios).std() > 0.2
    assert np.median(off(lift, ratios)) < 0.05
    continued = again.lift(keypoints, previous=lift)
    assert np.median(off(continued, ratios)) < 0.05


def off(lift: LiftedFrames, ratios: Float64) -> Float64:
    """Return how far the logs of the view's factors x over y (N,) are off."""
    found = lift.focals[:, VIEW, 0] / lift.focals[:, VIEW, 1]
    away: Float64 = np.abs(np.log(found / ratios))
    return away
