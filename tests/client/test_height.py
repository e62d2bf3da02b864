"""Scale by the body's height: of a body of average shares, whatever its pose and unit."""

import numpy as np
import pytest
from fewview.height import joints_of, scaled_to
from fewview.readers.skeletons import SKELETONS
from fewview.room import Room
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NAMES = [f"{side}_{joint}" for joint in ("shoulder", "hip", "knee", "ankle") for side in "lr"]


def body(height: float, bends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return frames (N, 8, 3) of a body with legs bent at hips and knees by angles in radians."""
    frames = []
    for bend in bends:
        legs = [np.array([0, 0.530, 0]) * height]
        for share, angle in ((0.245, bend), (0.246, -bend)):  # thigh and shin, from hip to ankle
            turn = Rotation.from_euler("x", angle).as_matrix()
            legs.append(legs[-1] - turn @ [0, share * height, 0])
        middle = [np.array([0, 0.818, 0]) * height, *legs]
        frames.append([point + np.array([side, 0, 0]) for point in middle for side in (-0.1, 0.1)])
    return np.array(frames)


def room(points: NDArray[np.float64]) -> Room:
    scales = np.full(len(points), 2.0)
    return Room(points, np.eye(3)[None], np.array([[0.0, 1.0, 4.0]]), 0, ("found",), scales)


def test_the_height_gives_the_unit() -> None:
    truth = body(1.7, np.linspace(0, 1.2, 50))
    truth[3, 5], truth[4] = np.nan, np.nan
    seen = 0.37 * (truth @ Rotation.random(rng=np.random.default_rng(0)).as_matrix())
    scaled = scaled_to(room(seen), 1.7, NAMES)
    np.testing.assert_allclose(scaled.points * 0.37, seen, rtol=1e-6)
    np.testing.assert_allclose(scaled.translations * 0.37, [[0, 1, 4]], rtol=1e-6)
    np.testing.assert_allclose(scaled.scales * 0.37, 2, rtol=1e-6)  # of deviations, too
    assert scaled.notes[0] == "found"
    assert "1.7" in scaled.notes[1]


@pytest.mark.parametrize("name", ["coco-17", "body-25", "body-25b", "h36m-17", "mediapipe-33"])
def test_joints_are_known_by_their_names(name: str) -> None:
    names = SKELETONS[name].names
    for joint, places in zip(("shoulder", "hip", "knee", "ankle"), joints_of(names), strict=True):
        assert [names[place].lower()[0] for place in places] == ["l", "r"]
        assert all(names[place].lower().endswith(joint) for place in places)


def test_what_cannot_be_measured_is_said() -> None:
    with pytest.raises(ValueError, match="left_ankle"):
        scaled_to(room(body(1.7, np.zeros(2))[:, :6]), 1.7, NAMES[:6])
    with pytest.raises(ValueError, match="there is no left_shoulder"):
        joints_of(None)
    with pytest.raises(ValueError, match="a frame that shows"):
        scaled_to(room(np.full((2, 8, 3), np.nan)), 1.7, NAMES)
