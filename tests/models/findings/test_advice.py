"""Checks that only advise fail alone: what they fail with is logged, and the others go on."""

import logging

import numpy as np
import pytest

from models.calibrating import doubts
from models.capture import checks
from models.capture.checks import capture_findings
from models.findings.advice import FAULTS
from models.settings.config import FitConfig
from models.training import keypoints_of_fit, synchronising
from models.training.trainer import fit
from tests.models.rigs import make_rig_capture

QUICK = {"steps": 3, "dictionary_sizes": (16, 8), "batch_size": 8, "refine": "off"}
RING = [0.0, 80.0, -120.0]


def failing(fault: type[Exception]) -> object:
    def check(*_args: object, **_more: object) -> None:
        raise fault("on purpose")

    return check


@pytest.mark.parametrize("fault", FAULTS)
def test_a_check_that_fails_leaves_the_others(
    fault: type[Exception], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keypoints = make_rig_capture(RING, frames=40).keypoints
    keypoints[:, :, 5] = np.nan
    keypoints[:, 2] = keypoints[:, 0]
    names = ("frozen_places", "_frozen", "absences", "_identical", "_normalised", "_outside")
    expected = {finding.code for finding in capture_findings(keypoints)}
    assert expected == {"keypoint_never_seen", "views_identical"}
    of_check = {"absences": "keypoint_never_seen", "_identical": "views_identical"}
    for name in (*names, "_motionless"):
        with monkeypatch.context() as patched:
            patched.setattr(checks, name, failing(fault))
            caplog.clear()
            found = {finding.code for finding in capture_findings(keypoints)}
        assert found == expected - {of_check.get(name)}
        (record,) = [one for one in caplog.records if one.levelno == logging.ERROR]
        assert record.exc_info is not None
        assert record.exc_info[0] is fault


@pytest.mark.parametrize(
    ("module", "name"),
    [
        (keypoints_of_fit, "frozen_places"),
        (keypoints_of_fit, "order_findings"),
        (keypoints_of_fit, "_left_out"),
        (checks, "_motionless"),
        (synchronising, "is_film"),
        (synchronising, "find_timing"),
    ],
)
def test_a_fit_goes_on_without_a_check_that_fails(
    module: object, name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keypoints = make_rig_capture(RING, frames=40).keypoints
    monkeypatch.setattr(module, name, failing(ZeroDivisionError))
    times = None if name == "is_film" else np.arange(40) / 50
    prior = fit(keypoints, FitConfig.model_validate(QUICK), times=times)
    assert prior.lift(keypoints).status == ("ok",) * 40
    assert "failed and is left out" in caplog.text


def test_cameras_are_found_without_the_checks_of_given_values(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(doubts, "_worst_doubts", failing(ZeroDivisionError))
    capture = make_rig_capture(RING, frames=30)
    lenses = [{"intrinsics": {"fx": lens.focal}} for lens in capture.lenses]
    given = QUICK | {"steps": 30, "refine": "auto", "calibration": lenses}
    assert fit(capture.keypoints, FitConfig.model_validate(given)).cameras is not None
    assert "failed and is left out" in caplog.text
