"""What is found of cameras that are known, from answers that are off as a network's would be."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.bundle.instrumental_equations import NoisyFrames
from models.bundle.problem import Scene
from models.calibrating.handedness import NothingFoundError
from models.calibrating.result import CameraReport, SelfCalibration, camera_report
from models.calibrating.self_calibration import (
    calibrate_by_geometry,
    self_calibrate,
    task_of,
    with_geometry,
)
from models.capture.metrics import pa_mpjpe
from models.numerics.steps import finished
from models.settings.calibration import Camera, Intrinsics
from models.settings.config import FitConfig
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, RigCapture, keypoint, make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]

AZIMUTHS = [0.0, 80.0, -120.0]
SHIN = (keypoint("left_knee"), keypoint("left_ankle"))
TRUNK = (keypoint("left_hip"), keypoint("right_shoulder"))
# Left, up, and ahead, where the head is held: a volume that is positive in most frames.
CORNERS = tuple(keypoint(name) for name in ("pelvis", "left_hip", "neck", "head"))


@pytest.fixture(scope="module")
def static() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=30)


@pytest.fixture(scope="module")
def mixed() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=40, moving=(2,))


@pytest.fixture(scope="module")
def moving() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=40, moving=(0, 1, 2))


def found_by(
    capture: RigCapture, *, mirrored: bool = False, sizes: bool = True, **config: Any
) -> tuple[SelfCalibration, Scene]:
    image_sizes = [IMAGE_SIZE] * len(capture.lenses) if sizes else None
    return finished(
        self_calibrate(
            task_of(capture.pixels, capture.weights, FitConfig.model_validate(config), image_sizes),
            capture.answers(mirrored=mirrored),
        )
    )


def camera(
    capture: RigCapture, view: int, *, posed: bool = True, turned: float = 0.0
) -> dict[str, Any]:
    """Return a view's true calibration; its pose may be left out, or turned by some degrees."""
    lens = capture.lenses[view]
    intrinsics = Intrinsics(
        model=lens.model,
        fx=lens.focal,
        fy=lens.focal,
        cx=lens.centre[0],
        cy=lens.centre[1],
        distortion=lens.distortion,
    )
    turn = Rotation.from_euler("y", turned, degrees=True).as_matrix()
    pose = {
        "rotation": (turn @ capture.rotations[0, view]).tolist(),
        "translation": capture.translations[0, view].tolist(),
    }
    known = {"intrinsics": intrinsics.model_dump(), **(pose if posed else {})}
    return Camera.model_validate(known).model_dump()


def error(capture: RigCapture, scene: Scene) -> float:
    """Metres; a mirror image is off by 0.17."""
    return pa_mpjpe(scene.points, capture.points3d, reflection="never").mean


def length(points: Float64, ends: tuple[int, int]) -> Float64:
    lengths: Float64 = np.linalg.norm(points[:, ends[0]] - points[:, ends[1]], axis=-1)
    return lengths


def trunk(capture: RigCapture) -> float:
    """Metres."""
    return float(np.median(length(capture.points3d, TRUNK)))


def in_unit(found: SelfCalibration, scene: Scene) -> float:
    """Return the lengths of trunks in the user's unit, for static cameras."""
    sizes = found.unit * np.exp(scene.sizes[:, 0])
    return float(np.median(sizes * length(scene.points, TRUNK)))


def degrees_apart(a: Float64, b: Float64) -> float:
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def check_lenses(
    cameras: CameraReport, focal: float = FOCAL, *, largest_relative_sd: float = 0.06
) -> None:
    """Focal lengths are right to some per cent, and no further off than their deviations allow."""
    off = np.abs(cameras.focals - focal).max(1)
    assert (off < 0.06 * focal).all()
    assert (off < 4 * cameras.focal_sds).all()
    assert (cameras.focal_sds < largest_relative_sd * focal).all()


def test_a_few_keypoints_far_off_do_not_raise_the_noise(static: RigCapture) -> None:
    rng = np.random.default_rng(5)
    keypoints = static.keypoints.copy()
    far = rng.random(keypoints.shape[:3]) < 0.02
    keypoints[far] += rng.choice([-60, 60], (far.sum(), 2))  # pixels
    found, _ = found_by(replace(static, keypoints=keypoints))
    assert found.noise < 1.5  # pixels, 1 of them noise


@pytest.mark.parametrize("mirrored", thorough_after(1, [True, False]))
def test_a_static_rig_is_found(static: RigCapture, *, mirrored: bool) -> None:
    found, scene = found_by(static, mirrored=mirrored)
    cameras = camera_report(found)
    assert cameras.arrangement == "static"
    assert cameras.findings == ()
    check_lenses(cameras)
    assert error(static, scene) < 0.012
    assert found.noise == pytest.approx(1, rel=0.15)
    # Of the noise, 1.25 px from keypoint to truth, structures take a part.
    assert (cameras.reprojection_errors < 1.25).all()
    assert (cameras.reprojection_errors > 0.5).all()
    turns = static.rotations[0]
    for view in range(3):
        ours = cameras.rotations[view] @ cameras.rotations[0].T
        assert degrees_apart(ours, turns[view] @ turns[0].T) < 1.5


def test_image_sizes_need_not_be_known(static: RigCapture) -> None:
    found, scene = found_by(static, sizes=False)
    assert camera_report(found).arrangement == "static"
    assert error(static, scene) < 0.015


def test_moving_cameras_are_found_to_move(moving: RigCapture) -> None:
    found, scene = found_by(moving, mirrored=True)
    cameras = camera_report(found)
    assert cameras.arrangement == "moving"
    assert np.isnan(cameras.rotations).all()
    assert np.isnan(cameras.translations).all()
    assert np.isnan(cameras.rotation_sds).all()
    # Shapes bend in more ways than models of them do, which counts for 8 %.
    check_lenses(cameras, largest_relative_sd=0.1)
    assert error(moving, scene) < 0.02
    rotations = scene.rotations
    off = [
        degrees_apart(ours[1] @ ours[0].T, truth[1] @ truth[0].T)
        for ours, truth in zip(rotations, moving.rotations, strict=True)
    ]
    assert np.median(off) < 2


def test_a_static_pair_is_distinguished_from_a_moving_camera(mixed: RigCapture) -> None:
    found, scene = found_by(mixed)
    cameras = camera_report(found)
    assert cameras.arrangement == "mixed"
    assert cameras.static.tolist() == [True, True, False]
    assert np.isfinite(cameras.rotations[:2]).all()
    assert np.isnan(cameras.rotations[2]).all()
    assert np.isnan(cameras.translation_sds[2]).all()
    check_lenses(cameras, largest_relative_sd=0.1)  # of the moving one, as above
    assert (cameras.focal_sds[:2] < 0.06 * FOCAL).all()
    assert error(mixed, scene) < 0.015
    turns = mixed.rotations[0]
    ours = cameras.rotations[1] @ cameras.rotations[0].T
    assert degrees_apart(ours, turns[1] @ turns[0].T) < 1.5
    # The moving one is right in every frame, beside the two static ones.
    lone, pair = int(found.rig.groups[2]), int(found.rig.groups[0])
    for n in (0, 15, 30):
        relative = scene.rotations[n, lone] @ scene.rotations[n, pair].T
        truth = mixed.rotations[n, 2] @ mixed.rotations[n, 0].T
        assert degrees_apart(relative @ cameras.rotations[0].T, truth) < 4


def test_what_is_declared_of_the_arrangement_counts(static: RigCapture) -> None:
    found, scene = found_by(static, cameras="moving")
    assert camera_report(found).arrangement == "moving"
    assert "declared" in found.reason
    assert error(static, scene) < 0.015
    found, scene = found_by(static, cameras="static")
    assert camera_report(found).arrangement == "static"
    assert "declared" in found.reason
    assert error(static, scene) < 0.012


@pytest.mark.thorough
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_hint_decides_against_what_little_perspective_there_is(*, mirrored: bool) -> None:
    far = make_rig_capture(AZIMUTHS, frames=20, distance=60, lenses=(Lens(focal=16_000),))
    a, b, c, d = (far.points3d[:, corner] for corner in CORNERS)
    volumes = (np.cross(b - a, c - a) * (d - a)).sum(-1)
    assert np.median(volumes) > 0
    _, scene = found_by(far, mirrored=mirrored)
    assert error(far, scene) < 0.02  # a little is enough, without a hint
    _, scene = found_by(far, mirrored=mirrored, handedness=CORNERS)
    assert error(far, scene) < 0.02
    swapped = (CORNERS[1], CORNERS[0], *CORNERS[2:])
    _, scene = found_by(far, mirrored=mirrored, handedness=swapped)
    assert error(far, scene) > 0.15
    image = scene._replace(points=scene.points * [1, 1, -1])
    assert error(far, image) < 0.02


def test_a_calibration_is_used_as_it_is_and_gives_metres(static: RigCapture) -> None:
    found, scene = found_by(static, calibration=[camera(static, k) for k in range(3)])
    cameras = camera_report(found)
    assert cameras.findings == ()
    assert "given" in cameras.reason
    np.testing.assert_allclose(cameras.rotations, static.rotations[0], atol=1e-9)
    np.testing.assert_allclose(cameras.translations, static.translations[0], rtol=1e-6)
    np.testing.assert_array_equal(cameras.focals, FOCAL)
    for deviations in (cameras.focal_sds, cameras.rotation_sds, cameras.translation_sds):
        assert (deviations == 0).all()
    assert in_unit(found, scene) == pytest.approx(
        np.median(length(static.points3d, TRUNK)), rel=0.01
    )
    assert error(static, scene) < 0.01


def test_poses_of_two_cameras_suffice_for_metres(static: RigCapture) -> None:
    given = [camera(static, 0), None, camera(static, 2)]
    found, scene = found_by(static, calibration=given)
    cameras = camera_report(found)
    assert cameras.findings == ()
    for view in (0, 2):
        np.testing.assert_allclose(cameras.rotations[view], static.rotations[0, view], atol=1e-9)
        assert cameras.focal_sds[view] == 0
    assert cameras.focal_sds[1] > 0
    assert cameras.focals[1] == pytest.approx(FOCAL, rel=0.06)
    assert in_unit(found, scene) == pytest.approx(
        np.median(length(static.points3d, TRUNK)), rel=0.02
    )


def test_a_bumped_camera_is_named_and_its_calibration_not_used(static: RigCapture) -> None:
    given = [camera(static, 0), camera(static, 1), camera(static, 2, turned=6)]
    found, scene = found_by(static, calibration=given)
    (finding,) = found.findings
    assert finding.code == "calibration_disagrees"
    assert finding.views == (2,)
    assert finding.evidence["noise_as_given"] > 1.5 * finding.evidence["noise"]
    cameras = camera_report(found)
    assert cameras.arrangement == "static"
    turns = static.rotations[0]
    ours = cameras.rotations[2] @ cameras.rotations[0].T
    assert degrees_apart(ours, turns[2] @ turns[0].T) < 1.5
    assert error(static, scene) < 0.012


def test_a_focal_length_that_is_unsure_is_improved(static: RigCapture) -> None:
    given = [camera(static, k, posed=False) for k in range(3)]
    for lens in given[:2]:
        lens["intrinsics"] |= {"fx": 1.1 * FOCAL, "fy": 1.1 * FOCAL}
    given[0]["intrinsics"]["focal_sd"] = 0.2
    found, _ = found_by(static, calibration=given)
    cameras = camera_report(found)
    assert abs(cameras.focals[0, 0] - FOCAL) < 0.04 * FOCAL
    assert cameras.focal_sds[0] > 0
    np.testing.assert_allclose(cameras.focals[1], 1.1 * FOCAL)  # given, with a deviation of 0
    np.testing.assert_allclose(cameras.focals[2], FOCAL)
    assert (cameras.focal_sds[1:] == 0).all()


def test_a_distorted_lens_is_found() -> None:
    capture = make_rig_capture(
        AZIMUTHS, frames=40, lenses=(Lens(distortion=(-0.25,)),), distance=2.5
    )
    found, scene = found_by(capture)
    cameras = camera_report(found)
    np.testing.assert_allclose(cameras.distortions[:, 0], -0.25, atol=0.05)
    check_lenses(cameras)
    assert error(capture, scene) < 0.01


@pytest.mark.thorough
def test_noisy_cameras_that_face_each_other_have_lenses_near_the_usual() -> None:
    """Rays to a point are nearly one there, so geometry alone does not determine lenses."""
    facing = make_rig_capture([0.0, 175.0], frames=120, noise=0, hidden=0, seed=4)
    exact = facing.keypoints
    noise, left = (np.random.default_rng(seed).standard_normal(exact.shape) for seed in (5, 6))
    detected = exact + 12 * noise
    clear = exact + 0.1 * (exact.mean(0) - exact) + 2 * left  # pulled, as by removing noise
    task = task_of(
        clear,
        facing.weights,
        FitConfig(),
        [IMAGE_SIZE] * 2,
        detected=detected,
        noisy=NoisyFrames(clear, detected, facing.weights, 12.0),
    )
    settled = finished(calibrate_by_geometry(finished(with_geometry(task))))
    assert settled is not None
    found, _ = settled
    assert found.static.all()
    np.testing.assert_allclose(found.rig.lenses.focals, FOCAL, rtol=0.12)


def test_a_fisheye_lens_is_taken_as_it_is_given() -> None:
    lens = Lens(focal=330, distortion=(-0.04, 0.02, -0.006, 0.001), model="fisheye")
    capture = make_rig_capture(AZIMUTHS, frames=40, lenses=(lens,), distance=1.5, noise=0.5)
    given = [camera(capture, k, posed=False) for k in range(3)]
    found, scene = found_by(capture, calibration=given)
    cameras = camera_report(found)
    assert set(cameras.camera_models) == {"fisheye"}
    np.testing.assert_array_equal(cameras.focals, 330)
    np.testing.assert_allclose(cameras.distortions[:, :4], np.tile(lens.distortion, (3, 1)))
    assert found.noise == pytest.approx(0.5, rel=0.15)
    assert error(capture, scene) < 0.01
    for pinhole in given:
        pinhole["intrinsics"] |= {"model": "pinhole", "distortion": ()}
    wrong, _ = found_by(capture, calibration=given)
    assert wrong.noise > 2 * found.noise


def test_a_fisheye_lens_is_found() -> None:
    lens = Lens(focal=330, model="fisheye")
    capture = make_rig_capture(AZIMUTHS, frames=40, lenses=(lens,), distance=1.5, noise=0.5)
    found, scene = found_by(capture)
    cameras = camera_report(found)
    assert set(cameras.camera_models) == {"fisheye"}
    assert "fisheye" in cameras.reason
    np.testing.assert_allclose(cameras.focals, 330, rtol=0.05)
    assert error(capture, scene) < 0.02


def test_keypoints_behind_the_cameras_are_reported(static: RigCapture) -> None:
    answers = static.answers()
    behind = self_calibrate(
        task_of(static.pixels, static.weights, FitConfig(), None),
        answers._replace(scales=-answers.scales),
    )
    with pytest.raises(NothingFoundError):
        finished(behind)


def test_unlike_lenses_are_distinguished_unless_declared_alike() -> None:
    lenses = (Lens(focal=700), Lens(focal=1400), Lens(focal=1000))
    capture = make_rig_capture([0.0, 80.0, -120.0], frames=45, lenses=lenses, noise=1.0)
    found, _ = found_by(capture)
    focals = camera_report(found).focals.mean(1)
    np.testing.assert_allclose(focals, [700, 1400, 1000], rtol=0.04)
    alike, _ = found_by(capture, cameras_alike=True)
    assert np.ptp(np.log(camera_report(alike).focals.mean(1))) < np.ptp(np.log(focals)) / 2


@pytest.mark.thorough
def test_lenses_of_two_kinds_are_found() -> None:
    lenses = (Lens(focal=800), Lens(focal=1500), Lens(focal=804), Lens(focal=1495))
    capture = make_rig_capture([0.0, 80.0, -120.0, 160.0], frames=60, lenses=lenses, noise=1.0)
    found, _ = found_by(capture)
    report = camera_report(found)
    np.testing.assert_allclose(report.focals.mean(1), [800, 1500, 804, 1495], rtol=0.03)
    scores = (report.focals.mean(1) - [800, 1500, 804, 1495]) / report.focal_sds
    assert np.abs(scores).max() < 4
