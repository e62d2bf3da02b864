"""Three cameras about a subject, each with another lens."""

import numpy as np
import pytest
from fewview.calibration import Camera
from scipy.spatial.transform import Rotation


@pytest.fixture
def cameras() -> list[Camera]:
    """Return a pinhole with two coefficients, one with eight, and a fisheye."""
    lenses = (
        (np.array([-0.2, 0.03]), False),
        (np.array([0.1, -0.02, 0.001, -0.002, 0.003, 0.05, 0.01, 0.002]), False),
        (np.array([0.02, -0.004, 0.001, 0.0005]), True),
    )
    found = []
    for place, (distortion, fisheye) in enumerate(lenses):
        turn = Rotation.from_euler("yx", [70 * place - 30, 10], degrees=True).as_matrix()
        found.append(
            Camera(
                name=f"cam_{'abc'[place]}",
                matrix=np.array([[900.0 + place, 0, 631.25], [0, 905.0, 355.75], [0, 0, 1]]),
                distortion=distortion,
                rotation=turn,
                translation=np.array([0.1 * place, -0.2, 4.0 + place]),
                size=(1280, 720),
                fisheye=fisheye,
            )
        )
    return found
