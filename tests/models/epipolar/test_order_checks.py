"""Faults that are planted in captures with known cameras, and captures without any."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.capture.synthetic import KEYPOINT_NAMES, synthetic_capture
from models.epipolar.order_checks import order_findings
from models.findings.finding import Finding
from tests.models.rigs import make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
FRAMES = 100


def capture(*, views: int = 3, noise: float = 1.0, seed: int = 0) -> Float64:
    """Return keypoints of a figure before static cameras."""
    azimuths = [0.0, 70.0, 150.0, 250.0][:views]
    return make_rig_capture(azimuths, frames=FRAMES, noise=noise, seed=seed).keypoints


def partners() -> list[int]:
    """Say which keypoint of the figure is the left or the right of each; itself in the middle."""
    swapped = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in KEYPOINT_NAMES]
    return [
        KEYPOINT_NAMES.index(swapped.get(side, side) + score + part) for side, score, part in sides
    ]


def found_in(keypoints: Float64) -> tuple[Finding, ...]:
    return order_findings(keypoints, np.asarray(np.isfinite(keypoints).all(-1), np.float64))


def frames_of(finding: Finding) -> NDArray[np.bool_]:
    mask = np.zeros(FRAMES, np.bool_)
    for first, last in finding.frames:
        mask[first : last + 1] = True
    return mask


@pytest.mark.parametrize("noise", thorough_after(1, [5.0, 0.0, 15.0]))
def test_captures_in_order_have_no_findings(noise: float) -> None:
    assert not found_in(capture(noise=noise))
    assert not found_in(capture(views=2, noise=noise))


@pytest.mark.parametrize("views", thorough_after(1, [2, 3]))
def test_moving_cameras_have_no_findings(views: int) -> None:
    moving = synthetic_capture(frames=FRAMES, views=views, noise=1, seed=1)
    assert not order_findings(moving.keypoints, moving.confidence)
    one = make_rig_capture([0.0, 70.0, 150.0][:views], frames=FRAMES, moving=(1,), seed=2)
    assert not found_in(one.keypoints)


@pytest.mark.parametrize(("views", "noise"), thorough_after(2, [(2, 1.0), (3, 1.0), (4, 10.0)]))
def test_views_that_changed_places_in_a_run_of_frames(views: int, noise: float) -> None:
    keypoints = capture(views=views, noise=noise)
    swapped = slice(60, 95)
    keypoints[swapped, :2] = keypoints[swapped, 1::-1]
    (finding,) = found_in(keypoints)
    assert finding.code == "views_swapped"
    assert finding.views == (0, 1)
    assert finding.frames == ((60, 94),)


def test_views_that_changed_places_in_nearly_half_of_the_frames_here_and_there() -> None:
    keypoints = capture(noise=3.0)
    swapped = np.random.default_rng(0).random(FRAMES) < 0.4
    keypoints[swapped] = keypoints[swapped][:, [0, 2, 1]]
    (finding,) = found_in(keypoints)
    assert (finding.code, finding.views) == ("views_swapped", (1, 2))
    assert (frames_of(finding) == swapped).all()


@pytest.mark.parametrize("run", [slice(None), slice(20, 60)])
@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_left_and_right_are_exchanged_in_one_view(run: slice, noise: float) -> None:
    keypoints = capture(noise=noise)
    keypoints[run, 2] = keypoints[run, 2][:, partners()]
    findings = found_in(keypoints)
    assert [finding.code for finding in findings] == ["left_right_swapped"]
    assert findings[0].views == (2,)
    expected = np.zeros(FRAMES, np.bool_)
    expected[run] = True
    found = frames_of(findings[0]) if findings[0].frames else np.ones(FRAMES, np.bool_)
    assert (found == expected).mean() > 0.95


def test_left_and_right_in_one_of_two_views_names_both() -> None:
    keypoints = capture(views=2)
    keypoints[:, 1] = keypoints[:, 1][:, partners()]
    (finding,) = found_in(keypoints)
    assert (finding.code, finding.views) == ("left_right_swapped", (0, 1))


def bumped(degrees: float, noise: float) -> Float64:
    """Return keypoints of which view 1 was turned from frame 55 on."""
    keypoints = capture(noise=noise)
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.6, 0.5])).as_matrix()
    rays = np.concatenate(((keypoints[55:, 1] - [640, 512]) / 1100, np.ones((45, 16, 1))), -1)
    turned = rays @ turn.T
    keypoints[55:, 1] = turned[..., :2] / turned[..., 2:] * 1100 + [640, 512]
    return keypoints


@pytest.mark.parametrize("ends", thorough_after(1, [30, 45, 70]))
def test_a_camera_that_was_bumped_while_another_had_ended(ends: int) -> None:
    keypoints = bumped(4.0, 1.0)
    keypoints[ends:, 2] = np.nan
    (finding,) = found_in(keypoints)
    assert finding.code == "camera_moved"
    assert finding.views in ((1,), (0, 1))  # two views alone do not say which of them it was
    assert abs(finding.frames[0][0] - 55) <= 1


@pytest.mark.parametrize(("degrees", "noise"), thorough_after(1, [(2.0, 1.0), (8.0, 5.0)]))
def test_a_camera_that_was_bumped(degrees: float, noise: float) -> None:
    keypoints = bumped(degrees, noise)
    (finding,) = found_in(keypoints)
    assert (finding.code, finding.views) == ("camera_moved", (1,))
    assert abs(finding.frames[0][0] - 55) <= 1
    shuffled = np.random.default_rng(0).permutation(FRAMES)
    assert "camera_moved" not in [finding.code for finding in found_in(keypoints[shuffled])]
