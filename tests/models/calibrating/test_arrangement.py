"""Which cameras count as static, where a small motion is no clear one."""

from dataclasses import replace

import numpy as np
import pytest

from models.calibrating.result import camera_report
from models.calibrating.self_calibration import self_calibrate, task_of
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import IMAGE_SIZE, RigCapture, make_rig_capture
from tests.tiers import thorough_after


def swaying(capture: RigCapture, view: int, pixels: float, noise: float) -> RigCapture:
    """Let the images of a view sway slowly by so many pixels (root mean square), and add noise."""
    rng = np.random.default_rng(5)
    times = np.linspace(0, 6, len(capture.keypoints))
    waves = np.array([np.sin(2 * np.pi * rate * times) for rate in (0.3, 0.7, 1.3)])
    sway = rng.standard_normal((2, 3)) @ waves  # (2, N)
    sway *= pixels / np.sqrt(np.square(sway).sum(0).mean())
    keypoints = capture.keypoints + noise * rng.standard_normal(capture.keypoints.shape)
    keypoints[:, view] += sway.T[:, None]
    return replace(capture, keypoints=keypoints)


@pytest.mark.parametrize(
    ("pixels", "noise", "static"),
    thorough_after(
        1,
        [
            (9.0, 1.0, [True, True, False]),
            (6.0, 5.0, [True, True, True]),  # it hardly adds to the noise
        ],
    ),
)
def test_a_motion_counts_if_it_is_beyond_the_noise(
    pixels: float, noise: float, static: list[bool]
) -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=40, noise=0.0, hidden=0.0)
    swayed = swaying(capture, 2, pixels, noise)
    task = task_of(swayed.pixels, swayed.weights, FitConfig(), [IMAGE_SIZE] * 3)
    found, _ = finished(self_calibrate(task, swayed.answers()))
    assert camera_report(found).static.tolist() == static
