"""Focal lengths of cameras that move, from shapes alone."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.calibrating.result import camera_report
from models.calibrating.self_calibration import self_calibrate, task_of
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import IMAGE_SIZE, Lens, RigCapture, make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]

USUAL = 1500.0  # pixels, nearly


def errors(
    capture: RigCapture, focals: Float64, arrangement: str = "moving"
) -> tuple[Float64, Float64]:
    """Return logs (K,) of the focal lengths over the true ones, also in standard deviations."""
    found, _ = finished(
        self_calibrate(
            task_of(capture.pixels, capture.weights, FitConfig(), [IMAGE_SIZE] * len(focals)),
            capture.answers(mirrored=False),
        )
    )
    cameras = camera_report(found)
    assert cameras.arrangement == arrangement
    off = np.log(cameras.focals.mean(1) / focals)
    return off, off / (cameras.focal_sds / cameras.focals.mean(1))


def check(capture: RigCapture, focals: Float64, arrangement: str = "moving") -> None:
    """Focal lengths are near the true ones, and no further off than their deviations allow."""
    off, scores = errors(capture, focals, arrangement)
    assert np.abs(off).max() < 0.25
    assert np.abs(scores).max() < 4


@pytest.mark.parametrize(
    ("focal", "noise", "azimuths"),
    thorough_after(
        1,
        [
            (2800.0, 3.0, [0.0, 90.0]),
            (700.0, 12.0, [0.0, 90.0]),
            (2800.0, 6.0, [0.0, 80.0, -120.0]),
        ],
    ),
)
def test_moving_cameras_have_the_focal_length_under_which_shapes_are_alike(
    focal: float, noise: float, azimuths: list[float]
) -> None:
    capture = make_rig_capture(
        azimuths,
        frames=50,
        moving=tuple(range(len(azimuths))),
        lenses=(Lens(focal=focal),),
        noise=noise,
        distance=4 * max(focal / USUAL, 0.6),
    )
    check(capture, np.full(len(azimuths), focal))


@pytest.mark.thorough
def test_unlike_lenses_of_moving_cameras_are_found() -> None:
    focals = [900.0, 2400.0, 1500.0]
    capture = make_rig_capture(
        [0.0, 80.0, -120.0],
        moving=(0, 1, 2),
        lenses=tuple(Lens(focal=focal) for focal in focals),
        noise=1.0,
    )
    check(capture, np.array(focals))


def test_a_moving_camera_has_a_lens_of_its_own_beside_static_ones() -> None:
    focals = [1500.0, 1500.0, 700.0]
    lenses = tuple(Lens(focal=focal) for focal in focals)
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=50, moving=(2,), lenses=lenses)
    check(capture, np.array(focals), "mixed")


@pytest.mark.parametrize(
    ("focals", "noise"),
    thorough_after(
        1,
        [
            ([900.0, 2400.0], 1.0),
            ([900.0, 2400.0, 1500.0], 40.0),  # too much noise for any lens to be found
        ],
    ),
)
def test_deviations_cover_what_noise_and_models_of_shapes_do_to_lenses(
    focals: list[float], noise: float
) -> None:
    capture = make_rig_capture(
        [0.0, 80.0, -120.0][: len(focals)],
        frames=50,
        moving=tuple(range(len(focals))),
        lenses=tuple(Lens(focal=focal) for focal in focals),
        noise=noise,
        distance=4 * 0.6,
    )
    _, scores = errors(capture, np.array(focals))
    assert np.abs(scores).max() < 3
