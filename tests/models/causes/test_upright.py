"""Which images are turned shows where most cameras have the direction upwards."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models.causes.upright import quarter_turns

DOWN_TO_AXES = Rotation.from_euler("x", 90, degrees=True)  # z of the room is up, y of images down


def cameras(turns: Sequence[float]) -> np.ndarray:
    """Cameras (K, 3, 3) about a subject, tilted by up to 30 degrees, turned in their image."""
    about = Rotation.from_euler(
        "z", 360 / len(turns) * np.arange(len(turns))[:, None], degrees=True
    )
    tilts = Rotation.from_euler("x", 10.0 * np.arange(len(turns))[:, None] % 40, degrees=True)
    rolls = Rotation.from_euler("z", np.array(turns)[:, None], degrees=True)
    return np.asarray((rolls * tilts * DOWN_TO_AXES * about).as_matrix())


@pytest.mark.parametrize("turns", [[0, 4, 0, -6], [90, 0, 3, 0], [0, 0, 180, 2], [0, -90, 0, 0, 8]])
def test_turns_are_found_in_any_frame(turns: Sequence[float]) -> None:
    expected = np.round(np.array(turns) / 90).astype(int) % 4
    rig = cameras(turns)
    found, against = quarter_turns(rig)
    assert np.array_equal(found, expected)
    frame = Rotation.from_rotvec([0.4, 2.0, -0.7]).as_matrix()
    again, same = quarter_turns(rig @ frame)
    assert np.array_equal(again, expected)
    assert same == pytest.approx(against)


def test_more_turns_are_less_likely() -> None:
    costs = [quarter_turns(cameras(turns))[1] for turns in ([0, 0, 0, 0], [90, 0, 0, 0])]
    assert costs[0] + 2 < costs[1]
