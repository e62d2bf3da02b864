"""What a self-calibration starts from: the keypoints, what the user told, and usual lenses."""

from collections.abc import Generator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, Scene, ShapePrior, Views, moving_rig, points_in_cameras
from models.bundle.shape_model import ShapeModel
from models.calibrating.image_sizes import Images
from models.optics.lenses.projection import COEFFICIENTS, Lenses, index_of, project
from models.settings.calibration import Camera

Float64 = NDArray[np.float64]
T = TypeVar("T")
Steps = Generator[None, None, T]  # yields between iterations, so that a fit can be stopped there

USUAL_FOCAL = 1.2  # times the longer side of the image: a field of view of 45 degrees
REST_SLACK = 1e-4  # of the image's side: differences of noise below which nothing is concluded


class Problem(NamedTuple):
    """The frames that a self-calibration looks at, and what is known of the cameras."""

    keypoints: Float64  # (N, K, P, 2) pixels
    weights: Float64  # (N, K, P) confidences
    images: Images
    size: float  # pixels, mean root-mean-square radius of a view
    reference: Rig  # moving cameras with lenses as they are given, or usual
    calibration: tuple[Camera | None, ...]  # K

    @property
    def side(self) -> float:
        """Pixels, the longest side of the images."""
        return self.images.side

    @property
    def told_lenses(self) -> NDArray[np.bool_]:
        """Which views' (K,) lenses the user gave."""
        return np.array([c is not None and c.intrinsics is not None for c in self.calibration])

    @property
    def posed(self) -> list[int]:
        """The views whose poses the user gave."""
        given = enumerate(self.calibration)
        return [k for k, camera in given if camera is not None and camera.rotation is not None]

    def views(self, noise: float) -> Views:
        """Return the keypoints, weighted for this noise in pixels."""
        return Views(self.keypoints, self.weights / noise**2)


class Solution(NamedTuple):
    """What explains the keypoints, and what it was found with."""

    rig: Rig
    scene: Scene
    prior: ShapePrior  # about every frame's structure
    shapes: ShapeModel
    noise: float  # pixels, not below the least that is reckoned with
    measured_noise: float  # pixels
    information: Float64  # (F, F) inverse covariance of what is free of the rig
    given_poses: bool = False  # whether the extrinsics are those that the user gave, and stay


def reprojection_distances(problem: Problem, rig: Rig, scene: Scene) -> Float64:
    """Pixels (N, K, P) from every keypoint to the projection of its point."""
    pixels = project(points_in_cameras(scene, rig), rig.lenses)
    distances: Float64 = np.linalg.norm(pixels - problem.keypoints, axis=-1)
    return distances


def grouped(members: list[int], views: int) -> NDArray[np.int64]:
    """Group 0 for the members, one of its own for every other view; (K,)."""
    groups = np.zeros(views, np.int64)
    others = [k for k in range(views) if k not in members]
    groups[others] = np.arange(1, len(others) + 1)
    return groups


def starting_rig(images: Images, calibration: Sequence[Camera | None]) -> Rig:
    """Return moving cameras with given lenses, or usual ones in the middle of the images."""
    views = len(images.sizes)
    focals = USUAL_FOCAL * images.sizes.max(1, keepdims=True) * np.ones(2)
    centres = images.middles.copy()
    distortion, models = np.zeros((views, COEFFICIENTS)), np.zeros(views, np.int8)
    models[:] = index_of("pinhole")
    for k, camera in enumerate(calibration):
        if camera is not None and camera.intrinsics is not None:
            lens = camera.intrinsics
            focals[k] = lens.fx, lens.fy
            centres[k] = lens.cx, lens.cy
            distortion[k, : len(lens.distortion)] = lens.distortion
            models[k] = index_of(lens.model)
    return moving_rig(Lenses(focals, centres, distortion, models))
