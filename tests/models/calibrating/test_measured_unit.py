"""The unit that a measured length in the subject, or distance between two cameras, gives."""

import numpy as np
import pytest
from numpy.typing import NDArray

from models.calibrating.result import camera_report
from models.settings.calibration import KnownLength
from tests.models.calibrating.test_self_calibration import (
    AZIMUTHS,
    SHIN,
    camera,
    found_by,
    in_unit,
    length,
    trunk,
)
from tests.models.rigs import RigCapture, make_rig_capture
from tests.tiers import thorough_after

Float64 = NDArray[np.float64]


@pytest.fixture(scope="module")
def static() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=24)


@pytest.fixture(scope="module")
def mixed() -> RigCapture:
    return make_rig_capture(AZIMUTHS, frames=24, moving=(2,))


def test_a_known_length_gives_the_unit(static: RigCapture) -> None:
    known = KnownLength(keypoints=SHIN, length=1000 * float(length(static.points3d, SHIN).mean()))
    found, scene = found_by(static, known_length=known)
    assert in_unit(found, scene) == pytest.approx(1000 * trunk(static), rel=0.02)
    cameras = camera_report(found)  # cameras too
    for view in (1, 2):
        apart = np.linalg.norm(centre(cameras.rotations, cameras.translations, view))
        truth = np.linalg.norm(centre(static.rotations[0], static.translations[0], view))
        assert apart == pytest.approx(1000 * truth, rel=0.03)


def test_a_known_distance_between_cameras_gives_the_unit(mixed: RigCapture) -> None:
    """In another unit than the capture, of two views that are static; the third moves."""
    known = {"views": (1, 0), "length": 1000 * distance(mixed, 0, 1)}
    found, scene = found_by(mixed, known_distance=known)
    assert "known_distance_not_used" not in {each.code for each in found.findings}
    cameras = camera_report(found)
    apart = np.linalg.norm(centre(cameras.rotations, cameras.translations, 1))
    assert apart == pytest.approx(known["length"], rel=1e-9)
    assert in_unit(found, scene) == pytest.approx(1000 * trunk(mixed), rel=0.05)


def test_a_known_distance_from_a_camera_that_moves_gives_no_unit(mixed: RigCapture) -> None:
    found, _ = found_by(mixed, known_distance={"views": (0, 2), "length": 7})
    (finding,) = [each for each in found.findings if each.code == "known_distance_not_used"]
    assert finding.views == (0, 2)
    assert "known_length" in finding.remedy
    assert found.unit == 1


@pytest.mark.parametrize("off", thorough_after(1, [1.5, 1.0]))
def test_a_known_length_goes_before_a_known_distance(static: RigCapture, off: float) -> None:
    shin = float(length(static.points3d, SHIN).mean())
    found, scene = found_by(
        static,
        known_length=KnownLength(keypoints=SHIN, length=off * shin),
        known_distance={"views": (1, 2), "length": distance(static, 1, 2)},
    )
    assert in_unit(found, scene) == pytest.approx(off * trunk(static), rel=0.02)
    contradictions = [each for each in found.findings if each.code == "known_length_disagrees"]
    assert len(contradictions) == (off > 1)
    for finding in contradictions:
        assert finding.evidence["ratio"] == pytest.approx(off, rel=0.05)


def test_what_was_measured_and_contradicts_the_calibration_is_reported_and_used(
    static: RigCapture,
) -> None:
    known = KnownLength(keypoints=SHIN, length=2 * float(length(static.points3d, SHIN).mean()))
    apart = {"views": (0, 2), "length": 2 * distance(static, 0, 2)}
    given = [camera(static, k) for k in range(3)]
    for measured in ({"known_length": known}, {"known_distance": apart}):
        found, scene = found_by(static, calibration=given, **measured)
        (finding,) = found.findings
        assert finding.code == "known_length_disagrees"
        assert finding.evidence["ratio"] == pytest.approx(2, rel=0.02)
        assert in_unit(found, scene) == pytest.approx(2 * trunk(static), rel=0.02)


def distance(capture: RigCapture, first: int, second: int) -> float:
    """Return how far two static cameras of a capture are apart."""
    places = [centre(capture.rotations[0], capture.translations[0], k) for k in (first, second)]
    return float(np.linalg.norm(places[1] - places[0]))


def centre(rotations: Float64, translations: Float64, view: int) -> Float64:
    """Return where a camera stands, seen from the first."""
    places: Float64 = -np.einsum("kji,kj->ki", rotations, translations)
    apart: Float64 = places[view] - places[0]
    return apart
