"""Static cameras in sides of the image, and exact images of points about one place."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.epipolar.pairs import Beliefs, RelativePoses
from models.epipolar.static_cameras import SeenPoints, StaticCameras
from tests.models.rigs import around

Float64 = NDArray[np.float64]

AZIMUTHS = [0.0, 65.0, 150.0, -120.0, -50.0]
FOCALS = np.array([0.9, 1.3, 1.1, 1.6, 1.0])  # sides


def exact_rig(views: int, *, distance: float = 4.0, focals: Float64 = FOCALS) -> StaticCameras:
    """Return cameras about the origin; the first is the frame of reference."""
    rotations, translations = around(AZIMUTHS[:views], distance)
    turns = rotations @ rotations[0].T
    shifts = translations - (turns @ translations[0])
    none = np.zeros((views, 2))
    return StaticCameras(np.log(focals[:views]), none, none.copy(), turns, shifts)


def exact_points(count: int = 120, *, distance: float = 4.0, seed: int = 0) -> Float64:
    """Return points (3, M) of radius one about the place that the cameras look at."""
    rng = np.random.default_rng(seed)
    middle = around([AZIMUTHS[0]], distance)[1][0]
    turn = Rotation.random(random_state=seed)
    return np.asarray(middle[:, None] + turn.apply(rng.uniform(-0.6, 0.6, (count, 3))).T)


def images_of(rig: StaticCameras, points: Float64, noise: float = 0.0, seed: int = 0) -> SeenPoints:
    """Return the images of points (3, M) through pinholes, by the textbook's equation."""
    held = rig.rotations @ points + rig.translations[..., None]
    images = np.exp(rig.log_focals)[:, None, None] * held[:, :2] / held[:, 2:]
    images += noise * np.random.default_rng(seed).normal(size=images.shape)
    return SeenPoints(images, np.ones((len(images), points.shape[1])))


def relative_poses(rig: StaticCameras, first: int, second: int) -> RelativePoses:
    """Return the one true solution of a pair of views."""
    turn = rig.rotations[second] @ rig.rotations[first].T
    shift = rig.translations[second] - turn @ rig.translations[first]
    return RelativePoses(
        turn[None],
        (shift / np.linalg.norm(shift))[None],
        np.exp(rig.log_focals[[first, second]])[None],
        np.zeros(1),
        1e-4,
    )


def believed(focals: Float64, sd: float = 0.5) -> Beliefs:
    """Return a prior of pinholes whose focal lengths are roughly these; `sd` 0: they are given."""
    views = len(focals)
    none = np.zeros((views, views))
    return Beliefs(focals, sd**2 * np.eye(views), none, np.stack((none, none)), alike=False)
