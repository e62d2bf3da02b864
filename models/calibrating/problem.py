"""The input of a self-calibration: keypoints, given values, and usual lenses."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import (
    CENTRE_X,
    CENTRE_Y,
    FOCAL,
    LENS,
    RADIAL,
    Rig,
    Scene,
    ShapePrior,
    Views,
    moving_rig,
    points_in_cameras,
)
from models.bundle.shape_model import ShapeModel
from models.calibrating.image_sizes import Images, ImageSizes, images_of
from models.capture.boxes import boxes_of
from models.epipolar.static_rig import Geometry
from models.numerics.rotations import rotations_from_vectors
from models.optics.lenses.projection import COEFFICIENTS, Lenses, index_of, project
from models.settings.calibration import Alike, Camera
from models.settings.config import FitConfig
from models.settings.lenses import Lens, alike_views, known_lenses, lens_of_each_view

Float64 = NDArray[np.float64]

USUAL_FOCAL = 1.2  # times the longer side of the image: a field of view of 45 degrees
# The same of a box: a subject that fills most of it at a distance of some eight heights; a guess.
USUAL_FOCAL_OF_BOXES = 6.0
CLEAR = 0.005  # noise as a share of the subject's size, from which it biases estimates with shapes
NOISE_SLACK = 1e-4  # of the image's side: differences of noise below which nothing is concluded


class Pose(NamedTuple):
    """The pose of a camera: x_cam = R x_world + t."""

    rotation: Float64  # (3, 3)
    translation: Float64  # (3,) in the user's unit


class LensPosterior(NamedTuple):
    """The posterior of the two log focal lengths of two static views, in sides of the image."""

    mean: Float64  # (2,)
    covariance: Float64  # (2, 2)
    of_kind: Float64  # (2, 2) about the same mean, if lenses are of the likelier kind (alike, not)
    peaks: tuple[float, ...]  # common focal lengths where it has peaks, the highest first


class CalibrationProblem(NamedTuple):
    """The frames of a self-calibration, and the given values and priors of the cameras."""

    keypoints: Float64  # (N, K, P, 2) pixels
    detected: Float64  # (N, K, P, 2) pixels, the same before noise was removed from them
    weights: Float64  # (N, K, P) confidences
    images: Images
    size: float  # pixels, mean root-mean-square radius of a view
    usual: Rig  # moving cameras with usual lenses, as if nothing was given
    reference: Rig  # moving cameras with lenses as they were given, or usual
    # (K, LENS) standard deviations of given lenses, in the numbers of `models.bundle.problem.VIEW`:
    # 0 for numbers that are held, infinity for those that are not given.
    lens_sds: Float64
    given_focals: Float64  # (K,) pixels, as they were given; NaN where they were not
    poses: tuple[Pose | None, ...]  # K, as they were given
    cameras_alike: Alike
    lens_groups: NDArray[np.int64]  # (K,) views of one number have alike lenses
    kept: NDArray[np.bool_]  # (K,) whose cameras are held as in a solution
    geometry: Geometry | None = None  # of all views, once it was sought
    lens_posterior: LensPosterior | None = None  # about `reference`, once two views have one

    @property
    def side(self) -> float:
        """Pixels, the longest side of the images."""
        return self.images.side

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which keypoints (N, P) two views or more show."""
        measured: NDArray[np.bool_] = (self.weights > 0).sum(1) > 1
        return measured

    @property
    def posed(self) -> list[int]:
        """The views with given poses."""
        return [k for k, pose in enumerate(self.poses) if pose is not None]

    def of(self, frames: NDArray[np.int64]) -> "CalibrationProblem":
        """Return the problem of some of the frames."""
        return self._replace(
            keypoints=self.keypoints[frames],
            detected=self.detected[frames],
            weights=self.weights[frames],
            geometry=self.geometry and self.geometry.of(frames),
        )

    def views(self, noise: float) -> Views:
        """Return the keypoints, weighted for this noise in pixels."""
        return Views(self.keypoints, self.weights / noise**2)


def problem_of(
    keypoints: Float64,
    weights: Float64,
    image_sizes: ImageSizes | None,
    config: FitConfig,
    *,
    detected: Float64 | None = None,
) -> CalibrationProblem:
    """Return the problem of keypoints (N, K, P, 2) with confidences (N, K, P), 0 if not observed.

    `detected` (N, K, P, 2) are the keypoints before noise was removed from them.
    """
    views = keypoints.shape[1]
    calibration = config.calibration or (None,) * views
    images = images_of(keypoints, weights, image_sizes)
    usual = usual_rig(images, boxes_of(keypoints, weights).stretched)
    reference, lens_sds = with_given_lenses(usual, calibration)
    alike = config.cameras_alike
    groups = np.arange(views) if alike is False else np.zeros(views, np.int64)
    if config.lenses is not None:
        lenses = lens_of_each_view(config.lenses, views)
        reference = _with_known_lenses(reference, lens_sds, lenses, image_sizes or (None,) * views)
        linked = any(lens is not None and lens.same_as is not None for lens in lenses)
        if linked and alike is not True:
            alike, groups = False, np.array(alike_views(lenses))
    return CalibrationProblem(
        keypoints,
        keypoints if detected is None else detected,
        weights,
        images,
        mean_radius(keypoints, weights),
        usual,
        reference,
        lens_sds,
        np.where(np.isfinite(lens_sds[:, FOCAL]), reference.lenses.focals.mean(1), np.nan),
        poses_of(calibration),
        alike,
        groups,
        kept=np.zeros(len(lens_sds), bool),
    )


def mean_radius(keypoints: Float64, weights: Float64) -> float:
    """Return the mean over views (N, K) of the root-mean-square radius of keypoints, pixels."""
    seen = (weights > 0)[..., None]
    counts = seen.sum(2)  # (N, K, 1)
    centres = np.where(seen, keypoints, 0.0).sum(2) / counts.clip(1)
    squared = np.square(np.where(seen, keypoints - centres[:, :, None], 0.0)).sum((2, 3))
    several = counts[..., 0] > 1
    return float(np.sqrt(squared[several] / counts[several][:, 0]).mean())


class GivenPoses(NamedTuple):
    """Given extrinsics, in units of the structure, and their standard deviations."""

    rotations: Float64  # (K, 3, 3)
    translations: Float64  # (K, 3)
    # (K, EXTRINSICS) standard deviations, radians and units: 0 for numbers that are held, infinity
    # for those that are not given or refused.
    sds: Float64

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which views (K,) have their given poses, exactly or nearly."""
        held: NDArray[np.bool_] = np.all(np.isfinite(self.sds), 1)
        return held


class Solution(NamedTuple):
    """A solution of a problem, with the priors it was estimated with."""

    rig: Rig
    scene: Scene
    prior: ShapePrior  # about every frame's structure
    shapes: ShapeModel
    noise: float  # pixels, not below its lower limit
    measured_noise: float  # pixels
    with_bones: bool = False  # whether bone lengths were used
    given_poses: GivenPoses | None = None  # the prior of the extrinsics; None: no given pose

    def of(self, frames: NDArray[np.int64]) -> "Solution":
        """Return the solution of some of the frames."""
        return self._replace(scene=self.scene.of(frames), prior=self.prior.of(frames))


def reprojection_distances(problem: CalibrationProblem, rig: Rig, scene: Scene) -> Float64:
    """Pixels (N, K, P) from every keypoint to the projection of its point."""
    pixels = project(points_in_cameras(scene, rig), rig.lenses)
    distances: Float64 = np.linalg.norm(pixels - problem.keypoints, axis=-1)
    return distances


def grouped(members: list[int], views: int) -> NDArray[np.int64]:
    """Return group 0 for the members, and a separate group for every other view; (K,)."""
    groups = np.zeros(views, np.int64)
    others = [k for k in range(views) if k not in members]
    groups[others] = np.arange(1, len(others) + 1)
    return groups


def poses_of(calibration: Sequence[Camera | None]) -> tuple[Pose | None, ...]:
    """Return the given poses, K of them."""
    return tuple(_pose_of(camera) for camera in calibration)


def with_given_lenses(usual: Rig, calibration: Sequence[Camera | None]) -> tuple[Rig, Float64]:
    """Return a rig with the given lenses, and `lens_sds` of `CalibrationProblem`."""
    lenses = copied(usual.lenses)
    sds = np.full((len(calibration), LENS), np.inf)
    for k, camera in enumerate(calibration):
        if camera is None or camera.intrinsics is None:
            continue
        given = camera.intrinsics
        lenses.models[k] = index_of(given.model)
        lenses.focals[k], sds[k, FOCAL] = given.focals, given.focal_sd
        if given.centre is not None:
            lenses.centres[k], sds[k, [CENTRE_X, CENTRE_Y]] = given.centre, 0
        if given.distortion is not None:
            lenses.distortion[k, : len(given.distortion)] = given.distortion
            sds[k, RADIAL:] = 0
    return usual._replace(lenses=lenses), sds


def _with_known_lenses(
    rig: Rig, lens_sds: Float64, lenses: Sequence[Lens | None], image_sizes: ImageSizes
) -> Rig:
    """Return a rig with the focal lengths that are known, unless given; write their `lens_sds`."""
    focals = rig.lenses.focals.copy()
    for k, known in enumerate(known_lenses(lenses, image_sizes)):
        if known is not None and np.isinf(lens_sds[k, FOCAL]):
            focals[k], lens_sds[k, FOCAL] = known.focal, known.sd
    return rig._replace(lenses=rig.lenses._replace(focals=focals))


def copied(lenses: Lenses) -> Lenses:
    """Return lenses that may be changed."""
    return Lenses(
        lenses.focals.copy(), lenses.centres.copy(), lenses.distortion.copy(), lenses.models.copy()
    )


def _pose_of(camera: Camera | None) -> Pose | None:
    if camera is None or camera.rotation is None or camera.translation is None:
        return None
    given = np.array(camera.rotation, np.float64)
    matrix = given if given.shape == (3, 3) else rotations_from_vectors(given)
    return Pose(matrix, np.array(camera.translation, np.float64))


def expecting_boxes(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem with usual lenses of boxes where views that move show boxes.

    Given focal lengths stay.
    """
    found = problem.geometry and problem.geometry.rig
    shown = boxes_of(problem.keypoints, problem.weights).shown
    shown &= np.isinf(problem.lens_sds[:, FOCAL]) & (True if found is None else ~found.static)
    factors = np.where(shown, USUAL_FOCAL_OF_BOXES / USUAL_FOCAL, 1.0)[:, None]  # (K, 1)

    def lengthened(rig: Rig) -> Rig:
        return rig._replace(lenses=rig.lenses._replace(focals=factors * rig.lenses.focals))

    return problem._replace(
        usual=lengthened(problem.usual), reference=lengthened(problem.reference)
    )


def usual_rig(images: Images, stretched: NDArray[np.bool_] | None = None) -> Rig:
    """Return moving cameras with usual lenses, centred in images some of which are `stretched`."""
    views = len(images.sizes)
    focals = USUAL_FOCAL * images.sizes.max(1, keepdims=True) * np.ones(2)
    models = np.full(views, index_of("pinhole"), np.int8)
    lenses = Lenses(focals, images.middles.copy(), np.zeros((views, COEFFICIENTS)), models)
    return moving_rig(lenses, stretched)
