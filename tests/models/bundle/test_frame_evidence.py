"""The evidence of frames against the marginal likelihood of a linear Gaussian model."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from models.bundle.frame_evidence import log_evidence
from models.bundle.problem import SIZE_SD, Rig, Scene, Views, make_rig, points_in_cameras
from models.bundle.separate_frames import adjust_frames
from models.optics.lenses.projection import project
from tests.models.bundle.problems import FRAMES, POINTS, Float64, make

STATIC = [0, 1, 3]  # the views of the rig
WIDE, STEP = 3.0, 1e-5  # standard deviation of a pose that nothing is known of; of differences
DEGREES_OF_FREEDOM = 8.0


def moved(scene: Scene, step: Float64) -> Scene:
    """Move a frame's points, then turn, shift and grow it."""
    turn = Rotation.from_rotvec(step[-7:-4]).as_matrix()
    return Scene(
        scene.points + step[:-7].reshape(scene.points.shape),
        turn @ scene.rotations,
        scene.translations + step[-4:-1],
        scene.sizes + step[-1],
    )


def of_frame(views: Views, rig: Rig, scene: Scene, frame: int) -> tuple[Float64, Float64, Float64]:
    """Residuals, their derivatives by all unknowns of a frame, and variances."""
    place = np.array([frame])
    seen = views.weights[frame] > 0
    unknowns = 3 * POINTS + 7

    def pixels(step: Float64) -> Float64:
        at = points_in_cameras(moved(scene.of(place), step), rig)
        return np.asarray(project(at, rig.lenses)[0][seen], np.float64)

    residuals = views.keypoints[frame][seen] - pixels(np.zeros(unknowns))
    derived = [
        (pixels(step) - pixels(-step)).ravel() / (2 * STEP) for step in STEP * np.eye(unknowns)
    ]
    variances = np.repeat(1 / views.weights[frame][seen], 2)
    return residuals.ravel(), np.stack(derived, -1), variances


def test_it_is_the_likelihood_with_structure_and_pose_integrated_out() -> None:
    problem = make(off=0.2)
    rig = make_rig(
        problem.rig.lenses.of(np.array(STATIC)),
        np.zeros(len(STATIC), np.int64),
        problem.rig.rotations[STATIC],
        problem.rig.translations[STATIC],
    )
    views = Views(problem.views.keypoints[:, STATIC], problem.views.weights[:, STATIC])
    first = problem.scene
    scene = Scene(
        first.points, first.rotations[:, :1], first.translations[:, :1], first.sizes[:, :1]
    )
    found = log_evidence(views, rig, problem.prior, scene)
    scene, _ = adjust_frames(views, rig, problem.prior, scene, iterations=100)
    basis, spread = problem.prior.basis, problem.prior.spread
    covariance = np.diag(np.repeat([spread**2, WIDE**2, SIZE_SD**2], [3 * POINTS, 6, 1]))
    covariance[: 3 * POINTS, : 3 * POINTS] += basis @ basis.T
    expected = []
    for frame in range(FRAMES):
        residuals, derived, variances = of_frame(views, rig, scene, frame)
        offsets = (scene.points[frame] - problem.prior.means[frame]).ravel()
        expects = derived @ np.concatenate((offsets, np.zeros(6), scene.sizes[frame]))
        marginal = multivariate_normal(
            np.zeros(len(residuals)), np.diag(variances) + derived @ covariance @ derived.T
        )
        numbers = residuals + expects
        squared = -2 * (marginal.logpdf(numbers) - marginal.logpdf(np.zeros(len(numbers))))
        heavy = DEGREES_OF_FREEDOM + len(numbers) - 7
        depths = points_in_cameras(scene, rig)[frame, ..., 2].mean(1)
        focals = rig.lenses.focals.mean(1)
        expected.append(
            marginal.logpdf(np.zeros(len(numbers)))
            + len(numbers) / 2 * np.log(2 * np.pi)
            + 6 * np.log(WIDE)
            + np.log(SIZE_SD)
            - heavy / 2 * np.log1p(squared / DEGREES_OF_FREEDOM)
            + (2 * np.log(focals) - 3 * np.log(depths)).mean()
        )
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_what_lies_behind_a_camera_has_none() -> None:
    problem = make(off=0.2)
    behind = problem.scene._replace(translations=-problem.scene.translations)
    found = log_evidence(problem.views, problem.rig, problem.prior, behind)
    assert np.isnan(found).all()


def test_a_frame_with_a_point_in_the_plane_of_a_camera_alone_has_none() -> None:
    """Its normal equations may be singular, which is no matter of the other frames."""
    problem = make(off=0.2)
    scene, rig = problem.scene, problem.rig
    expected = log_evidence(problem.views, rig, problem.prior, scene)
    depths = points_in_cameras(scene, rig)[0, ..., 2]
    for view, keypoint in np.ndindex(depths.shape):
        translations = scene.translations.copy()
        step = (depths[view, keypoint] - 1e-10) * rig.rotations[view, 2]
        translations[0, rig.groups[view]] -= step
        touching = scene._replace(translations=translations)
        found = log_evidence(problem.views, rig, problem.prior, touching)
        assert np.isnan(found[0])
        np.testing.assert_array_equal(found[1:], expected[1:])
