"""Static cameras from keypoints alone: drawn rigs that nobody chose, and what is left to shapes."""

import numpy as np
import pytest

from benchmarks.drawn_captures import draw_capture
from benchmarks.wide_net import by_geometry, measure
from models.bundle.problem import Scene
from models.calibrating.handedness import volume
from models.calibrating.result import SelfCalibration
from models.calibrating.self_calibration import calibrate_by_geometry, task_of, with_geometry
from models.capture.metrics import pa_mpjpe
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, RigCapture, keypoint, make_rig_capture
from tests.tiers import thorough_after

# Of the first draws those with three or four static cameras, few frames and the motion of the
# example, which is always at hand.
DRAWS = (154, 41, 7, 47, 77, 125, 178, 220, 223, 226, 229, 235)


def settled_in(
    capture: RigCapture, config: FitConfig | None = None
) -> tuple[SelfCalibration, Scene] | None:
    """Return the cameras and structures that geometry alone finds."""
    sizes = [IMAGE_SIZE] * len(capture.lenses)
    task = task_of(capture.pixels, capture.weights, config or FitConfig(), sizes)
    return finished(calibrate_by_geometry(finished(with_geometry(task))))


def found_in(capture: RigCapture, config: FitConfig | None = None) -> SelfCalibration | None:
    settled = settled_in(capture, config)
    return None if settled is None else settled[0]


@pytest.mark.parametrize("number", thorough_after(1, DRAWS))
def test_drawn_rigs_are_as_good_as_the_true_ones(number: int) -> None:
    draw = draw_capture(number)
    assert draw is not None
    assert not draw.moving
    row = measure(draw, by_geometry, None)
    assert row.ratio < 1.1
    assert not row.called_moving
    assert not row.mirrored


@pytest.mark.thorough
@pytest.mark.parametrize("number", [39, 111])
def test_lenses_of_two_views_are_not_surer_than_they_are_right(number: int) -> None:
    """Shapes of one are clear and bend; of the other they show the ratio of the lenses alone."""
    draw = draw_capture(number)
    assert draw is not None
    assert max(measure(draw, by_geometry, None).focal_scores) < 5


def test_a_draw_is_the_same_each_time() -> None:
    first, second = draw_capture(7), draw_capture(7)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.keypoints, second.keypoints)
    assert first.words == second.words


def test_three_static_cameras_are_settled_with_their_deviations() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=60, noise=2.0)
    found = found_in(capture)
    assert found is not None
    assert found.static.all()
    assert found.handedness_certainty > 0.99
    focals = np.array([lens.focal for lens in capture.lenses])
    scores = np.log(found.rig.lenses.focals.mean(1) / focals) / found.deviations[:, 0]
    assert np.abs(scores).max() < 4


@pytest.mark.thorough
def test_bones_do_not_bend_a_rig_that_noise_leaves_open() -> None:
    """Half a pixel of noise, where constant lengths prefer focal lengths that are 10 % off."""
    draw = draw_capture(76)
    assert draw is not None
    pixels = np.nan_to_num(draw.keypoints)
    weights = np.all(np.isfinite(draw.keypoints), -1).astype(np.float64)
    task = task_of(pixels, weights, FitConfig(), draw.sizes, detected=pixels)
    settled = finished(calibrate_by_geometry(finished(with_geometry(task))))
    assert settled is not None
    off = np.log(settled[0].rig.lenses.focals.mean(1) / draw.focals)
    assert np.abs(off).max() < 0.03
    assert np.abs(off / settled[0].deviations[:, 0]).max() < 3


def test_structures_follow_exact_keypoints_seen_from_far_away() -> None:
    capture = make_rig_capture(
        [0.0, 80.0, -120.0, 170.0], frames=40, noise=0.0, hidden=0.0, distance=14.0
    )
    settled = settled_in(capture)
    assert settled is not None
    _, scene = settled
    error = pa_mpjpe(scene.points, capture.points3d, reflection="never").mean
    assert error < 5e-5  # metres


@pytest.mark.parametrize("seed", thorough_after(1, [0, 1]))
def test_static_cameras_with_hardly_any_perspective_are_found(seed: int) -> None:
    """From so far away each pair of views fits many relative poses; three views fit one."""
    far = make_rig_capture(
        [0.0, 80.0, -120.0], frames=20, distance=60.0, lenses=(Lens(focal=16_000.0),), seed=seed
    )
    settled = settled_in(far)
    assert settled is not None
    found, scene = settled
    assert found.static.all()
    assert pa_mpjpe(scene.points, far.points3d, reflection="never").mean < 0.01  # metres


def test_an_open_handedness_does_not_keep_cameras_from_being_settled() -> None:
    far = make_rig_capture(
        [0.0, 80.0, -120.0], frames=20, distance=60.0, lenses=(Lens(focal=16_000.0),), noise=8.0
    )
    settled = settled_in(far)
    assert settled is not None
    found, scene = settled
    assert found.handedness_certainty < 0.99
    assert "handedness_not_observable" in {finding.code for finding in found.findings}
    assert pa_mpjpe(scene.points, far.points3d).mean < 0.06  # metres, whichever the hand


def test_a_given_handedness_that_no_frame_shows_decides_nothing() -> None:
    far = make_rig_capture(
        [0.0, 80.0, -120.0], frames=20, distance=60.0, lenses=(Lens(focal=16_000.0),), noise=8.0
    )
    corners = tuple(keypoint(name) for name in ("pelvis", "left_hip", "neck", "head"))
    far.keypoints[:, 1:, corners[3]] = np.nan  # one view alone sees it
    found = found_in(far, FitConfig.model_validate({"handedness": corners}))
    assert found is not None
    assert found.handedness_certainty < 0.99


def given(focal: float) -> dict[str, object]:
    """Return a calibration of a lens alone."""
    return {"intrinsics": {"fx": focal, "fy": focal}}


@pytest.mark.parametrize(
    ("azimuths", "focals"),
    thorough_after(
        1,
        [
            ([0.0, 80.0], [800.0, 1500.0]),
            ([0.0, 80.0], [1100.0, 1100.0]),
            ([0.0, 25.0], [1100.0, 1100.0]),
            ([0.0, 180.0], [1100.0, 1100.0]),  # they face each other
        ],
    ),
)
def test_two_static_cameras_have_the_lenses_under_which_shapes_are_alike(
    azimuths: list[float], focals: list[float]
) -> None:
    lenses = tuple(Lens(focal=focal) for focal in focals)
    capture = make_rig_capture(azimuths, frames=50, noise=1.0, lenses=lenses)
    found = found_in(capture)
    assert found is not None
    assert found.static.all()
    errors = np.log(found.rig.lenses.focals.mean(1) / focals)
    assert np.abs(errors).max() < 0.12
    assert np.abs(errors / found.deviations[:, 0]).max() < 4


@pytest.mark.parametrize(
    ("azimuths", "moving", "config"),
    [
        ([0.0, 80.0], (0, 1), {}),
        ([0.0, 80.0, -120.0], (0, 1, 2), {}),
        ([0.0, 80.0, -120.0, 170.0], (1,), {}),
        ([0.0, 80.0, -120.0], (), {"cameras": "moving"}),
    ],
)
def test_all_other_captures_are_left_to_shapes(
    azimuths: list[float], moving: tuple[int, ...], config: dict[str, object]
) -> None:
    """Cameras that move, or are declared to."""
    capture = make_rig_capture(azimuths, frames=40, moving=moving)
    assert found_in(capture, FitConfig.model_validate(config)) is None


def test_a_given_lens_that_keypoints_contradict_is_left_to_shapes() -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=40)
    lenses = [given(1.5 * FOCAL), given(FOCAL), given(FOCAL)]
    assert found_in(capture, FitConfig.model_validate({"calibration": lenses})) is None


def test_a_given_lens_is_kept() -> None:
    capture = make_rig_capture([0.0, 80.0], frames=40)
    found = found_in(capture, FitConfig.model_validate({"calibration": 2 * [given(FOCAL)]}))
    assert found is not None
    np.testing.assert_array_equal(found.rig.lenses.focals, FOCAL)
    np.testing.assert_array_equal(found.deviations[:, 0], 0)


@pytest.mark.parametrize("swapped", thorough_after(1, [True, False]))
def test_a_given_handedness_decides(*, swapped: bool) -> None:
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=40)
    a, b, c, d = (keypoint(name) for name in ("pelvis", "left_hip", "neck", "head"))
    corners = (a, c, b, d) if swapped else (a, b, c, d)
    found = found_in(capture, FitConfig.model_validate({"handedness": corners}))
    assert found is not None
    assert found.handedness_certainty == 1
    assert volume(found.shapes.mean[None], corners) > 0
