"""What no view shows, and what is stuck, is to a fit as if it were not there."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.capture.metrics import pa_mpjpe
from models.lifting.fitted_prior import FittedPrior
from models.settings.config import FitConfig
from models.training.trainer import Trainer, fit
from tests.models.rigs import RigCapture, make_rig_capture
from tests.sharing import fitted_once

Float64 = NDArray[np.float64]
QUICK: dict[str, Any] = {"steps": 30, "dictionary_sizes": (16, 8), "batch_size": 8}
GONE = 5


@pytest.fixture(scope="module")
def capture() -> RigCapture:
    return make_rig_capture([0.0, 80.0, -120.0], frames=20)


@pytest.fixture(scope="module")
def without(capture: RigCapture) -> FittedPrior:
    """Return the fit of a capture that never had the keypoint."""
    others = np.delete(capture.keypoints, GONE, axis=2)
    return fitted_once("without", lambda: fit(others, config_with(lambda p: p - (p > GONE))))


def config_with(place: Any) -> FitConfig:
    """Return a configuration that names keypoints, counted by `place`."""
    length = {"keypoints": [place(2), place(9)], "length": 0.7}
    hand = [place(p) for p in (1, 4, 8, 10)]
    return FitConfig.model_validate(QUICK | {"known_length": length, "handedness": hand})


def hidden(capture: RigCapture) -> Float64:
    keypoints = capture.keypoints.copy()
    keypoints[:, :, GONE] = np.nan
    return keypoints


@pytest.fixture(scope="module")
def prior(capture: RigCapture) -> FittedPrior:
    return fitted_once("hidden", lambda: fit(hidden(capture), config_with(int)))


def test_a_keypoint_that_no_view_shows_is_not_invented(
    capture: RigCapture, prior: FittedPrior, without: FittedPrior
) -> None:
    known = np.arange(16) != GONE
    for name, weights in without.weights.items():
        np.testing.assert_array_equal(prior.weights[name], weights)
    (found,) = [f for f in prior.findings if f.code == "keypoint_never_seen"]
    assert found.keypoints == (GONE,)
    copy = FittedPrior.from_bytes(prior.to_bytes())
    assert copy.to_bytes() == prior.to_bytes()
    assert copy.keypoints_per_frame == 16
    expected = without.lift(capture.keypoints[:, :, known])
    for some in (prior, copy):
        for keypoints in (hidden(capture), capture.keypoints):  # whatever new frames show of it
            lift = some.lift(keypoints)
            np.testing.assert_array_equal(lift.points3d[:, known], expected.points3d)
            np.testing.assert_array_equal(lift.keypoints_seen[:, known], expected.keypoints_seen)
            np.testing.assert_array_equal(lift.rotations, expected.rotations)
            assert np.isnan(lift.points3d[:, GONE]).all()
            assert not lift.keypoints_seen[:, GONE].any()
            assert np.isnan(lift.outlier_probability[:, :, GONE]).all()
            np.testing.assert_array_equal(
                lift.outlier_probability[:, :, known], expected.outlier_probability
            )
    again = prior.lift(capture.keypoints, previous=prior.lift(capture.keypoints))
    assert np.isfinite(again.points3d[:, known]).all()


def test_what_names_a_keypoint_that_no_view_shows_is_refused(capture: RigCapture) -> None:
    for more in (
        {"known_length": {"keypoints": [1, GONE], "length": 1}},
        {"handedness": [0, 1, 2, GONE]},
    ):
        with pytest.raises(ValueError, match=rf"{next(iter(more))} must name .* got {GONE}"):
            fit(hidden(capture), FitConfig.model_validate(QUICK | more))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("handedness", [1, 4, 8, 1]),
        ("handedness", [1, 4, 8, 16]),
        ("known_length", {"keypoints": [1, 1], "length": 0.7}),
        ("known_length", {"keypoints": [1, 16], "length": 0.7}),
    ],
)
def test_keypoints_that_cannot_be_meant_are_refused(
    capture: RigCapture, field: str, value: Any
) -> None:
    with pytest.raises(ValueError, match=field):
        Trainer(capture.keypoints, FitConfig.model_validate(QUICK | {field: value}))


def test_a_view_that_shows_nothing_has_no_outliers(capture: RigCapture) -> None:
    rng = np.random.default_rng(7)
    keypoints = np.tile(capture.keypoints, (3, 1, 1, 1)) + rng.normal(0, 0.5, (60, 3, 16, 2))
    wrong = rng.random(keypoints.shape[:3]) < 0.06
    keypoints[wrong] = rng.uniform(0, 1000, (int(wrong.sum()), 2))
    keypoints[:, 2] = np.nan
    read = Trainer(keypoints, FitConfig.model_validate(QUICK))
    (found,) = [f for f in read.result().findings if f.code == "outliers"]
    assert 2 not in found.views


def test_a_fit_may_start_from_one_that_knows_more_keypoints(
    capture: RigCapture, prior: FittedPrior
) -> None:
    config = FitConfig.model_validate(QUICK | {"refine": "off"})
    start = fit(capture.keypoints, config)
    trainer = Trainer(hidden(capture), config, start=start)
    steps = trainer.run()
    for _ in range(10):
        next(steps)
    resumed = Trainer(hidden(capture), config, checkpoint=trainer.checkpoint())
    for one in (steps, resumed.run()):
        assert len(list(one)) == 20
    assert resumed.result().to_bytes() == trainer.result().to_bytes()
    assert resumed.result().capture.known.all()
    with pytest.raises(ValueError, match=rf"has no keypoints \[{GONE}\]"):
        Trainer(capture.keypoints, prior.config, start=prior)


def test_a_keypoint_that_is_stuck_is_not_learnt_from(capture: RigCapture) -> None:
    config = FitConfig.model_validate(QUICK)
    stuck, marked = capture.keypoints.copy(), capture.keypoints.copy()
    stuck[:, 1, 3], marked[:, 1, 3] = 5, np.nan
    prior, expected = fit(stuck, config), fit(marked, config)
    for name, weights in expected.weights.items():
        np.testing.assert_array_equal(prior.weights[name], weights)
    (found,) = [f for f in prior.findings if f.code == "keypoint_frozen"]
    assert (found.views, found.keypoints) == ((1,), (3,))
    copy = FittedPrior.from_bytes(prior.to_bytes())
    lifts = [p.lift(k) for p, k in ((prior, stuck), (copy, stuck), (expected, marked))]
    for lift in lifts[:2]:
        np.testing.assert_array_equal(lift.points3d, lifts[2].points3d)
    errors = [pa_mpjpe(p.lift(stuck).points3d, capture.points3d).mean for p in (prior, expected)]
    # The other prior takes it for a detection, until a second look.
    assert errors[0] < 0.8 * errors[1]
    # Of views that are named, it is the fit's second; of unknown ones, none.
    pair = prior.lift(stuck[:, [1, 0]], views=[1, 0])
    np.testing.assert_array_equal(
        pair.points3d, expected.lift(marked[:, [1, 0]], views=[1, 0]).points3d
    )
