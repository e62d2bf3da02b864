"""Certainty of the handedness: from log odds of frames, and for cameras too far away."""

import numpy as np
import pytest

from models.calibrating.handedness import DECIDED, certainty
from models.calibrating.self_calibration import self_calibrate, task_of
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.calibrating.test_self_calibration import CORNERS
from tests.models.rigs import IMAGE_SIZE, Lens, make_rig_capture


def test_many_frames_that_agree_are_sure_and_few_that_differ_are_not() -> None:
    rng = np.random.default_rng(0)
    assert certainty([rng.normal(1, 1, 400)]) > DECIDED
    assert certainty([rng.normal(-1, 1, 400)]) < 1 - DECIDED
    assert 0.01 < certainty([rng.normal(0, 1, 400)]) < 0.99
    assert certainty([np.full(10, 1e-3)]) < 0.6  # they agree, but hardly say anything
    assert certainty([np.zeros(10)]) == certainty([]) == 0.5


def test_one_frame_does_not_decide_for_all() -> None:
    rng = np.random.default_rng(1)
    log_odds = rng.normal(-0.5, 1, 100)
    log_odds[0] = 1e6
    assert certainty([log_odds]) < 0.5


def test_evidence_of_both_kinds_counts() -> None:
    rng = np.random.default_rng(2)
    strong, weak = rng.normal(1, 1, 400), rng.normal(-0.1, 1, 100)
    assert certainty([strong, weak]) > DECIDED
    assert certainty([strong, -strong]) == pytest.approx(0.5)


@pytest.mark.parametrize("options", [False, True])
def test_cameras_that_are_too_far_away_leave_the_handedness_open(*, options: bool) -> None:
    lens = Lens(focal=900_000)
    far = make_rig_capture([0.0, 80.0], frames=20, distance=3600, lenses=(lens,), noise=3)
    given = {"fx": lens.focal, "fy": lens.focal, "cx": 640, "cy": 512}
    config = FitConfig.model_validate(
        {
            "calibration": [{"intrinsics": given}] * 2,
            "cameras": "moving",
            **({"handedness": CORNERS} if options else {}),
        }
    )
    sizes = [IMAGE_SIZE] * 2
    found, _ = finished(
        self_calibrate(task_of(far.pixels, far.weights, config, sizes), far.answers())
    )
    codes = [finding.code for finding in found.findings]
    if options:
        assert found.handedness_certainty == 1
        assert "handedness_not_observable" not in codes
    else:
        assert found.handedness_certainty < DECIDED
        assert "handedness_not_observable" in codes
