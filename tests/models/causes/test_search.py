"""What is wrong with one view's pixels is named, and nothing where nothing is wrong."""

import numpy as np
import pytest

from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem, problem_of
from models.causes.cause import mended
from models.causes.search import find_causes
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import IMAGE_SIZE, make_rig_capture

CAPTURE = make_rig_capture([0, 100, 220], frames=60, noise=0.7, hidden=0.02, distance=2.5)


def problem_with(keypoints: np.ndarray) -> CalibrationProblem:
    weights = np.isfinite(keypoints).all(-1).astype(np.float64)
    problem = problem_of(np.nan_to_num(keypoints), weights, [IMAGE_SIZE] * 3, FitConfig())
    return problem._replace(geometry=finished(geometry_of(problem, declared=False)))


def test_an_image_of_half_the_size_is_named_with_its_scale() -> None:
    keypoints = CAPTURE.keypoints.copy()
    keypoints[:, 1] = (keypoints[:, 1] + 0.5) / 2 - 0.5
    (cause,) = finished(find_causes(problem_with(keypoints)))
    assert (cause.kind, cause.view) == ("scaled", 1)
    assert cause.numbers["scale"] == pytest.approx(0.5, abs=3 * cause.sds["scale"] + 0.01)
    undone = mended(keypoints.astype(np.float32), None, None, (cause,)).keypoints
    assert np.nanmax(np.abs(undone - CAPTURE.keypoints)) < 15


def test_nothing_is_named_where_nothing_is_wrong() -> None:
    assert finished(find_causes(problem_with(CAPTURE.keypoints))) == ()
