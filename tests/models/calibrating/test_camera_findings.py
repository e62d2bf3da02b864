"""Findings of cameras, from calibrations with one thing wrong at a time."""

from dataclasses import replace

import numpy as np
import pytest

from models.bundle.problem import CENTRE_X, FOCAL, RADIAL, VIEW, make_rig, moving_rig
from models.bundle.shape_model import NetworkErrors, ShapeModel
from models.calibrating.camera_findings import camera_findings
from models.calibrating.image_sizes import Images
from models.calibrating.problem import CalibrationProblem, problem_of
from models.calibrating.result import SelfCalibration
from models.findings.finding import Finding
from models.network.settling import SETTLE_ALL
from models.optics.lenses.projection import COEFFICIENTS, Lenses
from models.settings.config import FitConfig
from models.settings.lenses import Lens
from tests.models.rigs import around

IMAGES = Images(
    np.full((2, 2), [1280.0, 1024.0]), np.full((2, 2), [640.0, 512.0]), np.ones(2, np.bool_)
)
SIZE = 100.0  # pixels
GIVEN = 1100.0  # pixels, the focal lengths of `calibration`


def calibration(azimuth: float = 90.0) -> SelfCalibration:
    """Return two ordinary static cameras, `azimuth` degrees apart."""
    lenses = Lenses(
        np.full((2, 2), 1100.0),
        IMAGES.middles.copy(),
        np.zeros((2, COEFFICIENTS)),
        np.zeros(2, np.int8),
    )
    rotation = np.array([[np.cos(a), 0, np.sin(a)] for a in np.radians([0, azimuth])])
    down = np.array([0.0, 1.0, 0.0])
    poses = np.stack([np.stack((np.cross(down, z), down, z)) for z in rotation])
    return SelfCalibration(
        make_rig(lenses, np.zeros(2, np.int64), poses, around([0.0, azimuth])[1]),
        np.full((2, VIEW), 0.01),
        ShapeModel(np.zeros((5, 3)), np.zeros((5, 3, 1)), 0.1),
        NetworkErrors(np.zeros((5, 3, 1)), 0.2, np.array([0.3, 0.2])),
        SETTLE_ALL,
        noise=2.0,
        unit=1.0,
        reprojection_errors=np.ones(2),
        reason="",
    )


def problem(**lens: float) -> CalibrationProblem:
    """Return the problem of these images, with what is known of the second lens, if anything."""
    config = FitConfig(lenses=[None, Lens(**lens)] if lens else None)
    sizes = [(1280, 1024)] * 2
    asked = problem_of(np.zeros((1, 2, 5, 2)), np.ones((1, 2, 5)), sizes, config)
    return asked._replace(images=IMAGES, size=SIZE)


def findings(found: SelfCalibration, **lens: float) -> dict[str, Finding]:
    return {finding.code: finding for finding in camera_findings(problem(**lens), found)}


def test_ordinary_cameras_give_no_finding() -> None:
    assert not findings(calibration())


def test_two_views_do_not_show_how_they_move() -> None:
    static = calibration()
    moving = replace(static, rig=moving_rig(static.rig.lenses))
    assert "arrangement_not_observable" in findings(moving)
    held = replace(moving, deviations=np.zeros((2, VIEW)))
    assert "arrangement_not_observable" not in findings(held)
    assert not camera_findings(problem(), moving, declared=True)


@pytest.mark.parametrize("azimuth", [178.0, 4.0])
def test_views_from_opposite_sides_or_the_same_one(azimuth: float) -> None:
    found = findings(calibration(azimuth))
    assert list(found) == ["views_opposite"]
    assert found["views_opposite"].severity == "info"
    assert found["views_opposite"].evidence["degrees"] == pytest.approx(azimuth)


def test_keypoints_that_are_noisy_for_the_size_of_the_subject() -> None:
    found = findings(replace(calibration(), noise=30.0))
    assert found["noise_high"].evidence["share_of_subject"] == pytest.approx(0.3)


def test_a_focal_length_that_cannot_be_seen() -> None:
    unsure = calibration()
    unsure.deviations[1, FOCAL] = 0.4
    assert findings(unsure)["focal_not_observable"].views == (1,)


@pytest.mark.parametrize(("focal", "sd", "disagrees"), [(1.19, 0.05, False), (1.23, 0.05, True)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_lens_that_keypoints_contradict(
    focal: float, sd: float, disagrees: bool, sign: int
) -> None:
    found = findings(calibration(), focal=GIVEN * focal**sign, sd=sd)
    assert list(found) == ["lens_disagrees"] * disagrees
    if disagrees:
        assert found["lens_disagrees"].views == (1,)
        evidence = found["lens_disagrees"].evidence
        assert evidence["given_focal_px"] == pytest.approx(GIVEN * focal**sign)
        assert evidence["focal_px"] == pytest.approx(GIVEN)


def test_lenses_unlike_real_ones_unless_they_were_given() -> None:
    long, bent, off = calibration(), calibration(), calibration()
    long.rig.lenses.focals[0] = 10_000
    bent.rig.lenses.distortion[1, 0] = 2.5
    off.rig.lenses.centres[0, 0] = 3000
    for found, view in ((long, 0), (bent, 1), (off, 0)):
        assert findings(found)["lenses_extreme"].views == (view,)
        found.deviations[:, [FOCAL, CENTRE_X, RADIAL]] = 0
        assert not findings(found)
