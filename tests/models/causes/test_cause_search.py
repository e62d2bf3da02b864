"""What is wrong with one view's pixels is named, and nothing where nothing is wrong."""

from collections.abc import Callable

import numpy as np
import pytest

from models.calibrating.keypoint_rig import geometry_of
from models.calibrating.problem import CalibrationProblem, problem_of
from models.capture.synthetic import KEYPOINT_NAMES
from models.causes.cause import mended
from models.causes.cause_search import find_causes
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import IMAGE_SIZE, make_rig_capture

CAPTURE = make_rig_capture([0, 100, 220], frames=20, noise=0.7, hidden=0.02, distance=2.5)


def problem_with(keypoints: np.ndarray, size: tuple[int, int] = IMAGE_SIZE) -> CalibrationProblem:
    weights = np.isfinite(keypoints).all(-1).astype(np.float64)
    problem = problem_of(np.nan_to_num(keypoints), weights, [size] * 3, FitConfig())
    return problem._replace(geometry=finished(geometry_of(problem, declared=False)))


def test_an_image_of_half_the_size_is_named_with_its_scale() -> None:
    keypoints = CAPTURE.keypoints.copy()
    keypoints[:, 1] = (keypoints[:, 1] + 0.5) / 2 - 0.5
    (cause,) = finished(find_causes(problem_with(keypoints)))
    assert (cause.kind, cause.view) == ("scaled", 1)
    assert cause.numbers["scale"] == pytest.approx(0.5, abs=3 * cause.sds["scale"] + 0.01)
    undone = mended(keypoints.astype(np.float32), None, None, (cause,)).keypoints
    assert np.nanmax(np.abs(undone - CAPTURE.keypoints)) < 15


@pytest.mark.thorough
def test_a_mirror_image_is_named_and_undone() -> None:
    keypoints = CAPTURE.keypoints.copy()
    keypoints[:, 2, :, 0] = IMAGE_SIZE[0] - 1 - keypoints[:, 2, :, 0]
    (cause,) = finished(find_causes(problem_with(keypoints)))
    assert (cause.kind, cause.view) == ("mirrored", 2)
    undone = mended(keypoints.astype(np.float32), None, None, (cause,)).keypoints
    assert np.nanmax(np.abs(undone - CAPTURE.keypoints)) < 1e-3


def test_a_mirror_image_whose_sides_the_detector_exchanged_is_undone() -> None:
    names = list(KEYPOINT_NAMES)
    partners = [names.index(_other_side(name)) for name in names]
    keypoints = CAPTURE.keypoints.copy()
    keypoints[:, 2, :, 0] = IMAGE_SIZE[0] - 1 - keypoints[:, 2, :, 0]
    keypoints[:, 2] = keypoints[:, 2][:, partners]
    (cause,) = finished(find_causes(problem_with(keypoints)))
    assert (cause.kind, cause.view, cause.partners) == ("mirrored", 2, tuple(partners))
    assert cause.finding(applied=False).evidence["sides_exchanged"] == 1
    undone = mended(keypoints.astype(np.float32), None, None, (cause,)).keypoints
    assert np.nanmax(np.abs(undone - CAPTURE.keypoints)) < 1e-3


def _other_side(name: str) -> str:
    side, _, part = name.partition("_")
    return {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "harm"),
    [
        ("axes_exchanged", lambda pixels: pixels[..., ::-1]),
        ("stretched", lambda pixels: pixels * (1, 0.75)),
        ("cropped", lambda pixels: pixels - (310, 170)),
        ("padded", lambda pixels: pixels * (1, 0.8) + (0, 102.4)),
    ],
)
def test_no_harm_is_named_wrongly(kind: str, harm: Callable[[np.ndarray], np.ndarray]) -> None:
    keypoints = CAPTURE.keypoints.copy()
    keypoints[:, 2] = harm(keypoints[:, 2])
    causes = finished(find_causes(problem_with(keypoints)))
    assert {(cause.kind, cause.view) for cause in causes} <= {(kind, 2)}


def test_cameras_that_stretch_the_sides_alike_are_named_together() -> None:
    u = CAPTURE.keypoints[..., 0] / 640 - 1  # of a 4:3 image, which is 16:9 afterwards
    keypoints = CAPTURE.keypoints.copy()
    keypoints[..., 0] = 853 * (1 + u * (0.82 + 0.18 * u**2))
    causes = finished(find_causes(problem_with(keypoints, (1706, 1024))))
    assert [(cause.kind, cause.view) for cause in causes] == [("stretched", k) for k in range(3)]
    assert {cause.numbers["bend"] for cause in causes} == {0.18}


def test_nothing_is_named_where_nothing_is_wrong() -> None:
    assert finished(find_causes(problem_with(CAPTURE.keypoints))) == ()
