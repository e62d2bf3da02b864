"""What a fit reports of its own answers."""

from copy import copy
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import pytest

from models.lifting.fit_report import FitReport, fit_report, scale_sd
from models.settings.calibration import KnownLength
from tests.models.posterior.test_deviations import capture, prior


@cache
def report() -> FitReport:
    keypoints = capture().keypoints
    return fit_report(prior(), prior().lift(keypoints), keypoints)


def test_errors_are_those_of_the_answers() -> None:
    sds = prior().lift(capture().keypoints).points3d_sd.astype(np.float64)
    found = report()
    assert found.expected_error == pytest.approx(np.sqrt(np.square(sds).mean()), rel=1e-6)
    assert found.expected_error is not None
    assert found.of_keypoints == pytest.approx(np.sqrt(np.square(sds).mean(0)), rel=1e-6)
    assert found.of_frames == pytest.approx(np.sqrt(np.square(sds).mean(1)), rel=1e-6)
    assert f"{100 * found.expected_error / found.size:.2g} %" in found.verdict


def test_the_more_views_the_better() -> None:
    worth = {row.views: row.expected_error for row in report().of_views}
    assert len(worth) == 7
    assert worth[0, 1, 2] == pytest.approx(report().expected_error)
    for views, error in worth.items():
        for more, less in worth.items():
            if set(views) < set(more):
                assert less < error
    errors = [row.expected_error for row in report().of_views]
    assert all(first <= second for first, second in pairwise(errors))


def test_cameras_are_where_they_are() -> None:
    """Those of the capture are 80 degrees to one side of the first, and 120 to the other."""
    azimuths = [direction.azimuth_deg for direction in report().cameras]
    assert azimuths[0] == pytest.approx(0, abs=1e-6) or azimuths[0] == pytest.approx(360)
    between = sorted(min(azimuth, 360 - azimuth) for azimuth in azimuths[1:])
    np.testing.assert_allclose(between, [80, 120], atol=3)


def test_one_more_camera_helps_most_where_none_is() -> None:
    found = report()
    assert found.best_place is not None
    assert found.expected_error is not None
    errors = {place.direction: place.expected_error for place in found.places}
    assert max(errors.values()) < found.expected_error
    assert found.best_place.expected_error == min(errors.values())
    beside_first = next(error for direction, error in errors.items() if direction == (0, 0))
    assert found.best_place.expected_error < beside_first
    assert "One more camera" in found.verdict or found.best_place.expected_error > 0.85 * (
        found.expected_error
    )


def test_doubtful_frames_are_named() -> None:
    keypoints = np.array(capture().keypoints)
    keypoints[10:15] = keypoints[10:15][:, :, np.random.default_rng(0).permutation(16)]
    keypoints[20] = np.nan
    found = fit_report(prior(), prior().lift(keypoints), keypoints)
    assert set(found.worst_frames[:5]) == set(range(10, 15))
    assert set(found.reasons[10:15]) == {"unlike_fit"}
    assert found.reasons[20] == "no_evidence"
    assert found.quality[20] == 0
    assert found.of_frames[20] is None
    assert "frames are doubtful" in found.verdict


def test_the_scale_may_be_off_by_as_much_as_is_expected() -> None:
    """With every bone as the known length, against what all bones agree on."""
    assert report().scale_sd is None
    keypoints, truth = capture().keypoints, capture().points3d
    lift, scores = prior().lift(keypoints), []
    for a, b in combinations(range(truth.shape[1]), 2):
        true = np.linalg.norm(truth[:, a] - truth[:, b], axis=-1)
        if true.std() > 0.001 * true.mean():
            continue
        measured = copy(prior())
        known = KnownLength(keypoints=(a, b), length=1.0)
        measured.config = prior().config.model_copy(update={"known_length": known})
        sd = scale_sd(measured, lift)
        assert sd is not None
        ours = np.median(np.linalg.norm(lift.points3d[:, a] - lift.points3d[:, b], axis=-1))
        scores.append((np.log(ours / true.mean()), sd))
    off, expected = np.array(scores).T
    assert len(off) == 15
    assert 0.5 < np.sqrt(np.mean(np.square((off - np.median(off)) / expected))) < 2


def test_weak_perspective_is_not_known() -> None:
    keypoints = capture().keypoints
    found = fit_report(prior(), prior().lift(keypoints, refine="off"), keypoints)
    assert found.expected_error is None
    assert not found.of_views
    assert not found.places
    assert "not known" in found.verdict
