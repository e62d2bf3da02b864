"""Wrong given cameras: refined or refused, in the right view."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.calibrating.result import SelfCalibration, camera_report
from models.calibrating.self_calibration import self_calibrate, task_of
from models.findings.finding import Finding
from models.numerics.steps import finished
from models.settings.config import FitConfig
from tests.models.calibrating.test_self_calibration import camera
from tests.models.rigs import FOCAL, IMAGE_SIZE, Lens, RigCapture, make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]
Calibration = list[dict[str, Any] | None]

AZIMUTHS = [0.0, 80.0, -120.0, 160.0]
VIEWS = len(AZIMUTHS)


@pytest.fixture(scope="module")
def rig() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=30)


def calibration(rig: RigCapture, *, posed: bool = True) -> Calibration:
    return [camera(rig, view, posed=posed) for view in range(len(rig.lenses))]


def calibrated(rig: RigCapture, given: Calibration, **config: Any) -> SelfCalibration:
    found, _ = finished(
        self_calibrate(
            task_of(
                rig.pixels,
                rig.weights,
                FitConfig.model_validate({"calibration": given, **config}),
                [IMAGE_SIZE] * len(rig.lenses),
            ),
            rig.answers(),
        )
    )
    return found


def bumped(given: Calibration, view: int, degrees: float, axis: str) -> Calibration:
    """Turn a camera about itself, as a bump does."""
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    harmed = [dict(camera or {}) for camera in given]
    for part in ("rotation", "translation"):
        harmed[view][part] = (turn @ np.array(harmed[view][part])).tolist()
    return list(harmed)


def with_lens(given: Calibration, view: int, **change: Any) -> Calibration:
    harmed = [dict(camera or {}) for camera in given]
    harmed[view]["intrinsics"] = {**harmed[view]["intrinsics"], **change}
    return list(harmed)


HARMS: list[tuple[str, int, dict[str, float]]] = [
    ("bump y", 1, {"degrees": 3}),
    ("lens", 0, {"fx": 0.9 * FOCAL, "fy": 0.9 * FOCAL}),
    ("lens", 3, {"cx": 700.0}),
    ("bump x", 0, {"degrees": 1.5}),
    ("bump z", 2, {"degrees": 10}),
    ("bump x", 3, {"degrees": 6}),
    ("lens", 1, {"fx": 1.1 * FOCAL, "fy": 1.1 * FOCAL}),
    ("lens", 2, {"fx": 1.3 * FOCAL, "fy": 1.3 * FOCAL}),
    ("lens", 1, {"cx": 600.0, "cy": 590.0, "fx": 1.2 * FOCAL, "fy": 1.2 * FOCAL}),
]


def harmed(given: Calibration, kind: str, view: int, change: dict[str, float]) -> Calibration:
    if kind.startswith("bump"):
        return bumped(given, view, change["degrees"], kind[-1])
    return with_lens(given, view, **change)


@pytest.mark.parametrize(("kind", "view", "change"), thorough_after(3, HARMS))
def test_the_view_whose_calibration_is_off_is_named(
    rig: RigCapture, kind: str, view: int, change: dict[str, float]
) -> None:
    found = calibrated(rig, harmed(calibration(rig), kind, view, change))
    assert [finding.code for finding in found.findings] == ["calibration_disagrees"]
    assert found.findings[0].views == (view,)
    assert found.findings[0].evidence["noise_as_given"] > 1.3 * found.noise
    assert f"[{view}]" in found.reason
    # The others' stay what they are, and with them the frame of reference and the unit.
    cameras = camera_report(found)
    others = [k for k in range(VIEWS) if k != view]
    np.testing.assert_allclose(cameras.rotations[others], rig.rotations[0, others], atol=1e-9)
    np.testing.assert_allclose(cameras.translations[others], rig.translations[0, others], rtol=1e-6)
    assert (cameras.focals[others] == FOCAL).all()
    if kind.startswith("bump"):
        turned = cameras.rotations[view] @ rig.rotations[0, view].T
        assert Rotation.from_matrix(turned).magnitude() < np.radians(1)


@pytest.mark.parametrize("kind", ["inverted", "reversed"])
def test_poses_that_are_meant_otherwise_are_used_as_they_are_meant(
    rig: RigCapture, kind: str
) -> None:
    given = calibration(rig)
    if kind == "reversed":
        given = given[::-1]
    else:
        for view, each in enumerate(given):
            assert each is not None
            turn, shift = rig.rotations[0, view], rig.translations[0, view]
            each["rotation"], each["translation"] = turn.T.tolist(), (-turn.T @ shift).tolist()
    found = calibrated(rig, given)
    assert [finding.code for finding in found.findings] == ["calibration_read_otherwise"]
    cameras = camera_report(found)
    np.testing.assert_allclose(cameras.rotations, rig.rotations[0], atol=1e-6)
    np.testing.assert_allclose(cameras.translations, rig.translations[0], rtol=1e-5, atol=1e-9)


def codes(found: SelfCalibration) -> set[str]:
    return {finding.code for finding in found.findings}


def test_what_is_right_is_kept_without_a_word(rig: RigCapture) -> None:
    for posed in (True, False):
        found = calibrated(rig, calibration(rig, posed=posed))
        assert found.findings == ()
        assert (camera_report(found).focals == FOCAL).all()


def test_poses_of_another_session_are_refused_together(rig: RigCapture) -> None:
    given = calibration(rig)
    for view, degrees in enumerate((40, -30, 70, 20)):
        given = bumped(given, view, degrees, "zyxz"[view])
    found = calibrated(rig, given)
    assert codes(found) == {"calibration_disagrees"}
    assert {view for finding in found.findings for view in finding.views} == set(range(VIEWS))
    cameras = camera_report(found)
    assert cameras.arrangement == "static"
    assert (cameras.rotation_sds[1:] > 0).all()


@pytest.mark.thorough
def test_two_poses_that_contradict_each_other_are_both_named(rig: RigCapture) -> None:
    given = bumped(calibration(rig), 1, 20, "y")
    for view in (2, 3):
        given[view] = None
    found = calibrated(rig, given)
    assert codes(found) == {"calibration_disagrees"}
    assert {view for finding in found.findings for view in finding.views} == {0, 1}


def test_an_identity_freezes_nothing(rig: RigCapture) -> None:
    # Of view 0 alone, and of all views: the latter cannot be, and is rejected.
    identity = {"rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 4.0]}
    lenses = calibration(rig, posed=False)
    alone: Calibration = [{**(lenses[0] or {}), **identity}, *lenses[1:]]
    rejected: Calibration = [{**(lens or {}), **identity} for lens in lenses]
    for given, disagreeing in ((alone, set()), (rejected, {"calibration_disagrees"})):
        found = calibrated(rig, given)
        cameras = camera_report(found)
        assert codes(found) == disagreeing
        assert cameras.arrangement == "static"
        assert (cameras.rotation_sds[1:] > 0).all()
        turns = rig.rotations[0]
        for view in range(1, VIEWS):
            ours = cameras.rotations[view] @ cameras.rotations[0].T
            off = Rotation.from_matrix(ours @ (turns[view] @ turns[0].T).T).magnitude()
            assert off < np.radians(1.5)


def test_with_a_focal_length_alone_everything_else_is_found(rig: RigCapture) -> None:
    found = calibrated(rig, [{"intrinsics": {"fx": FOCAL}}] * VIEWS)
    cameras = camera_report(found)
    assert found.findings == ()
    assert (cameras.focals == FOCAL).all()
    assert (cameras.focal_sds == 0).all()
    assert (cameras.principal_point_sds > 0).all()
    off = np.abs(cameras.principal_points - np.array(IMAGE_SIZE) / 2)
    assert (off < 4 * cameras.principal_point_sds + 1).all()


def test_rodrigues_vectors_are_the_same_as_matrices(rig: RigCapture) -> None:
    given = calibration(rig)
    for entry in given:
        assert entry is not None
        entry["rotation"] = Rotation.from_matrix(entry["rotation"]).as_rotvec().tolist()
    cameras = camera_report(calibrated(rig, given))
    np.testing.assert_allclose(cameras.rotations, rig.rotations[0], atol=1e-9)


def test_a_fisheye_given_as_a_pinhole_is_refused() -> None:
    fisheye = Lens(focal=500, model="fisheye")
    capture = make_rig_capture(AZIMUTHS, frames=30, lenses=(fisheye,), distance=1.5, noise=0.5)
    given = with_lens(calibration(capture), 2, model="pinhole", distortion=[])
    (finding,) = calibrated(capture, given).findings
    assert (finding.code, finding.views) == ("calibration_disagrees", (2,))


def test_cameras_declared_static_that_move_are_obeyed_and_reported(rig: RigCapture) -> None:
    moving = make_rig_capture(AZIMUTHS, frames=30, moving=(2,))
    found = calibrated(moving, [None] * VIEWS, cameras="static")
    assert camera_report(found).arrangement == "static"
    (finding,) = [f for f in found.findings if f.code == "rig_declared_but_moving"]
    assert finding.views == (2,)
    assert finding.evidence["noise_if_static"] > 2 * finding.evidence["noise"]
    assert codes(calibrated(rig, [None] * VIEWS, cameras="static")) <= set()


def test_a_finding_is_one_line(rig: RigCapture) -> None:
    found = calibrated(rig, bumped(calibration(rig), 1, 5, "y"))
    (finding,) = found.findings
    assert isinstance(finding, Finding)
    assert "views 1" in str(finding)
    assert finding.evidence["degrees"] == pytest.approx(5, abs=1)
