"""Covariances of a small static rig: against GTSAM's, and against errors of many draws of noise."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.bundle.adjustment import RigPrior, adjust
from models.bundle.problem import (
    FOCAL,
    LENS,
    RADIAL,
    RADIAL_2,
    VIEW,
    Rig,
    Scene,
    Views,
    make_rig,
    make_shape_prior,
    points_in_cameras,
)
from models.numerics.steps import finished
from models.optics.lenses.projection import Lenses, project
from models.posterior.frames import Frames, LearntShapes, covariances_of
from models.posterior.learning import LENS_SDS, camera_factor
from tests.models.posterior.test_frame import dense, without_gauge

Float64 = NDArray[np.float64]

POINTS, VIEWS, COMPONENTS = 12, 3, 2
NOISE, SPREAD = 1.5, 0.05  # pixels; units of the structure
FRAMES, DRAWS = 20, 500  # of errors
FOR_GTSAM, ANYWHERE = 4, 100.0  # frames, and the deviation of points that no shape holds
HELD = 1e-5  # deviation of what fixes GTSAM's frame of reference and unit
TURN, SHIFT = slice(LENS, LENS + 3), slice(LENS + 3, VIEW)


class Capture(NamedTuple):
    """Structures of N frames, seen by one rig."""

    rig: Rig
    shapes: LearntShapes
    scene: Scene

    @property
    def pixels(self) -> Float64:
        """Where the cameras see the points (N, K, P, 2)."""
        return project(points_in_cameras(self.scene, self.rig), self.rig.lenses)

    def frames(self, seen: Views) -> Frames:
        """Return the capture as frames of the posterior, in the unit of each structure."""
        rig, scene, count = self.rig, self.scene, len(seen.weights)
        growth = np.exp(-scene.sizes[:, 0])
        shifts = np.einsum("kij,nj->nki", rig.rotations, scene.translations[:, 0])
        return Frames(
            scene.points,
            np.ascontiguousarray(rig.rotations @ scene.rotations),
            growth[:, None, None] * (shifts + rig.translations),
            rig.lenses,
            np.ones((count, VIEWS), np.bool_),
            growth[:, None, None] * rig.translations,
            growth,
            *seen,
            np.tile(np.eye(3), (count, 1, 1)),
            np.zeros(count),
            np.ones((count, POINTS)),
        )


def draw(rng: np.random.Generator, frames: int) -> Capture:
    """Draw structures; the rig and the shapes are always the same."""
    fixed = np.random.default_rng(0)
    mean, basis = fixed.standard_normal((POINTS, 3)), fixed.standard_normal((POINTS, 3, COMPONENTS))
    mean, basis = mean - mean.mean(0), 0.2 * basis
    distortion = np.zeros((VIEWS, 8))
    distortion[:, :2] = [[-0.08, 0.02], [0.03, 0.0], [-0.05, 0.01]]
    middle = np.array([0.0, 0.0, 7.0])
    turns = Rotation.from_euler("yx", [[0, 0], [50, 8], [-70, -5]], degrees=True).as_matrix()
    focals, centres = [[900.0] * 2, [1000.0] * 2, [1150.0] * 2], [[500.0, 400.0]] * VIEWS
    lenses = Lenses(np.array(focals), np.array(centres), distortion, np.zeros(VIEWS, np.int8))
    rig = make_rig(lenses, np.zeros(VIEWS, np.int64), turns, middle - turns @ middle)
    points = mean + np.einsum("piq,nq->npi", basis, rng.standard_normal((frames, COMPONENTS)))
    scene = Scene(
        points + SPREAD * rng.standard_normal(points.shape),
        Rotation.random(frames, rng=rng).as_matrix()[:, None],
        middle + 0.3 * rng.standard_normal((frames, 1, 3)),
        0.1 * rng.standard_normal((frames, 1)),
    )
    return Capture(rig, LearntShapes(mean, basis, np.full(POINTS, SPREAD**2)), scene)


def shown_of(rng: np.random.Generator, frames: int) -> NDArray[np.bool_]:
    """Return which keypoints (N, K, P) are shown: at least those of two views."""
    hiding = rng.integers(0, 3 * VIEWS, (frames, 1, POINTS))
    return np.asarray(hiding != np.arange(VIEWS)[:, None])


def numbers(*of_lenses: int) -> Float64:
    """Return 1 (K, 11) for what is free: numbers of lenses, and all poses but the first."""
    free = np.zeros((VIEWS, VIEW))
    free[:, of_lenses] = 1
    free[1:, LENS:] = 1
    return free


def without_size(rig: Rig, columns: Float64) -> Float64:
    """Project numbers (11 K, C) of a rig off its size."""
    axis = np.zeros((VIEWS, VIEW))
    axis[:, SHIFT] = rig.translations / np.linalg.norm(rig.translations)
    return np.asarray(columns - np.outer(axis, axis.ravel() @ columns))


def assert_alike(found: Float64, expected: Float64, share: float) -> None:
    """Two covariances differ by no more than a share of the deviations of both coordinates."""
    varying = expected.diagonal() > 1e-9 * expected.diagonal().max()
    scale = np.sqrt(expected.diagonal()[varying])
    apart = (found - expected)[np.ix_(varying, varying)] / scale / scale[:, None]
    assert np.abs(apart).max() < share


class Sums(NamedTuple):
    """Sums over draws of squares of errors, and of what covariances expect of them."""

    errors: Float64
    expected: Float64

    @classmethod
    def of(cls, size: int) -> "Sums":
        return cls(np.zeros((size, size)), np.zeros((size, size)))

    def add(self, error: Float64, expected: Float64) -> None:
        self.errors[:] += np.outer(error, error)
        self.expected[:] += expected


def adjusted(truth: Capture, seen: Views, free: Float64) -> Capture:
    """Adjust rig and structures to keypoints, from the truth."""
    precision = np.zeros((VIEWS, VIEW))
    precision[:, FOCAL] = LENS_SDS[FOCAL] ** -2
    held = RigPrior(truth.rig, np.diag(precision.ravel()), free.ravel() > 0)
    means = np.tile(truth.shapes.mean, (len(seen.weights), 1, 1))
    shapes = make_shape_prior(means, truth.shapes.basis, SPREAD)
    found = finished(adjust(seen, truth.rig, shapes, truth.scene, rig_prior=held))
    return truth._replace(rig=found.rig, scene=found.scene)


@pytest.mark.thorough
def test_errors_of_draws_are_as_their_covariances_expect() -> None:
    """Structures and noise drawn 500 times, with rig and structures adjusted to each draw."""
    rng, free = np.random.default_rng(1), numbers(FOCAL)
    of_points, of_cameras = Sums.of(3 * POINTS), Sums.of(free.size)
    for _ in range(DRAWS):
        truth = draw(rng, FRAMES)
        shown = shown_of(rng, FRAMES)
        pixels = truth.pixels + NOISE * rng.standard_normal((*shown.shape, 2))
        seen = Views(pixels, shown / NOISE**2)
        answer = adjusted(truth, seen, free)
        # As if no error repeated: in so few keypoints some do by chance, and cameras are doubted.
        frames = answer.frames(seen._replace(keypoints=answer.pixels))
        factor = camera_factor(frames, truth.shapes, answer.rig, free)
        expected = covariances_of(frames, truth.shapes, factor)
        for n, points in enumerate(answer.scene.points):
            kept = without_gauge(points, 7)
            error = (points - truth.scene.points[n]).ravel()
            of_points.add(kept @ error, kept @ dense(expected, n) @ kept)
        off = RigPrior(truth.rig, np.eye(free.size), free.ravel() > 0).offset(answer.rig)
        rows = without_size(truth.rig, factor.reshape(free.size, -1))
        of_cameras.add(without_size(truth.rig, off[:, None])[:, 0], rows @ rows.T)
    assert_alike(of_points.errors, of_points.expected, 0.06)
    assert_alike(of_cameras.errors, of_cameras.expected, 0.25)


@pytest.mark.thorough
def test_covariances_are_those_of_gtsam() -> None:
    """Of a bundle adjustment, where no shape is known."""
    gtsam: Any = pytest.importorskip("gtsam")
    rng, free = np.random.default_rng(2), numbers(FOCAL, RADIAL, RADIAL_2)
    drawn, shown = draw(rng, FOR_GTSAM), shown_of(rng, FOR_GTSAM)
    frames = drawn.frames(Views(drawn.pixels, shown / NOISE**2))
    shapes = drawn.shapes._replace(variances=np.full(POINTS, ANYWHERE**2))
    factor = camera_factor(frames, shapes, drawn.rig, free)
    found = covariances_of(frames, shapes, factor)
    of_points, of_cameras = by_gtsam(gtsam, drawn, shown)
    for n, points in enumerate(drawn.scene.points):
        kept = without_gauge(points, 7)
        assert_alike(kept @ dense(found, n) @ kept, kept @ of_points[n] @ kept, 0.02)
    rows = without_size(drawn.rig, factor.reshape(free.size, -1))
    expected = without_size(drawn.rig, without_size(drawn.rig, of_cameras).T)
    assert_alike(rows @ rows.T, expected, 0.02)


def by_gtsam(gtsam: Any, drawn: Capture, shown: NDArray[np.bool_]) -> tuple[Float64, Float64]:
    """Return covariances (N, 3 P, 3 P) of structures, and (11 K, 11 K) of the rig's numbers."""
    rig, scene, pixels = drawn.rig, drawn.scene, drawn.pixels
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses, lenses = [0, 1, 2], [10, 11, 12]
    for k in range(VIEWS):
        focal, (x, y) = rig.lenses.focals[k, 0], rig.lenses.centres[k]
        lens = gtsam.Cal3Bundler(focal, *rig.lenses.distortion[k, :2], x, y)
        turn = rig.rotations[k].T
        pose = gtsam.Pose3(gtsam.Rot3(turn), -turn @ rig.translations[k])
        values.insert(poses[k], pose)
        values.insert(lenses[k], lens)
        sds = np.array([LENS_SDS[FOCAL] * focal, LENS_SDS[RADIAL], LENS_SDS[RADIAL_2]])
        known = gtsam.noiseModel.Diagonal.Sigmas(sds)
        graph.add(gtsam.PriorFactorCal3Bundler(lenses[k], lens, known))
    first, second = values.atPose3(poses[0]), values.atPose3(poses[1])
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, HELD)
    graph.add(gtsam.PriorFactorPose3(poses[0], first, fixed))
    fixed = gtsam.noiseModel.Isotropic.Sigma(1, HELD)
    graph.add(gtsam.RangeFactorPose3(poses[0], poses[1], first.range(second), fixed))
    turned = scene.points @ scene.rotations[:, 0].mT
    held = np.exp(scene.sizes)[..., None] * turned + scene.translations  # in the rig
    white = gtsam.noiseModel.Isotropic.Sigma(2, NOISE)
    places = 100 + np.arange(FOR_GTSAM * POINTS).reshape(FOR_GTSAM, POINTS)
    for n, p in np.ndindex(places.shape):
        values.insert(int(places[n, p]), held[n, p])
        for view in np.flatnonzero(shown[n, :, p]):
            keys = poses[view], int(places[n, p]), lenses[view]
            graph.add(gtsam.GeneralSFMFactor2Cal3Bundler(pixels[n, view, p], white, *keys))
    marginals = gtsam.Marginals(graph, values)
    of_points = np.empty((FOR_GTSAM, 3 * POINTS, 3 * POINTS))
    for n in range(FOR_GTSAM):
        whole = marginals.jointMarginalCovariance([int(key) for key in places[n]]).fullMatrix()
        back = np.kron(np.eye(POINTS), np.exp(-scene.sizes[n, 0]) * scene.rotations[n, 0].T)
        of_points[n] = back @ whole @ back.T
    whole = marginals.jointMarginalCovariance(poses + lenses).fullMatrix()
    to_ours = np.zeros((VIEWS, VIEW, len(whole)))
    for k in range(VIEWS):
        # A rotation vector and a translation in the camera's axes, of the camera in the rig.
        turn, shift, lens = 6 * k + np.arange(3), 6 * k + 3 + np.arange(3), 6 * VIEWS + 3 * k
        to_ours[k, TURN, turn] = -np.eye(3)
        to_ours[k, SHIFT, shift] = -np.eye(3)
        to_ours[k, SHIFT][:, turn] = np.cross(np.eye(3), rig.translations[k])
        to_ours[k, FOCAL, lens] = 1 / rig.lenses.focals[k, 0]
        to_ours[k, [RADIAL, RADIAL_2], [lens + 1, lens + 2]] = 1.0
    rows = to_ours.reshape(VIEWS * VIEW, -1)
    rows[:VIEW][LENS:] = 0.0
    return of_points, rows @ whole @ rows.T
