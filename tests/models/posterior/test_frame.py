"""The information on cameras, against a dense Hessian of the posterior as it is written down."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag

from models.bundle.problem import LENS, VIEW
from models.numerics.rotations import rotations_from_vectors
from models.optics.lenses.projection import COEFFICIENTS, Lenses, project
from models.posterior.frames import (
    Covariances,
    Frames,
    LearntShapes,
    scores_of,
)

Float64 = NDArray[np.float64]

POINTS, COMPONENTS, STEP = 5, 2, 1e-4
NOISE = 2.0  # pixels
LENS_STEPS = np.array([1.0, 100.0, 100.0, 1.0, 1.0])  # of the lens's numbers, in units of STEP


class Case:
    """A frame whose answer explains its keypoints exactly, with one view's keypoint hidden."""

    def __init__(self, joined: list[bool], seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        views = len(joined)
        self.joined = np.array(joined)
        self.mean = rng.standard_normal((POINTS, 3))
        self.mean -= self.mean.mean(0)
        self.shapes = LearntShapes(
            self.mean,
            0.3 * rng.standard_normal((POINTS, 3, COMPONENTS)),
            rng.uniform(0.01, 0.05, POINTS),
        )
        turn = rotations_from_vectors(rng.standard_normal((1, 3)))[0]
        self.turned = 1.3 * turn
        self.points = self.mean @ self.turned.T
        axes = np.stack([[0.0, 1.2 * k, 0.1 * k] for k in range(views)])
        self.rotations = rotations_from_vectors(axes)
        self.translations = np.tile([0.1, -0.2, 9.0], (views, 1))
        self.growth = 0.7
        self.offsets = 0.5 * self.translations
        self.lenses = Lenses(
            np.full((views, 2), 900.0),
            np.full((views, 2), [500.0, 400.0]),
            0.05 * rng.standard_normal((views, COEFFICIENTS)) * [1, 1, *[0] * (COEFFICIENTS - 2)],
            np.zeros(views, np.int8),
        )
        self.weights = rng.uniform(0.5, 1, (views, POINTS)) / NOISE**2
        self.weights[0, 2] = 0
        self.keypoints = self.pixels(np.zeros(self.size))

    @property
    def size(self) -> int:
        """Numbers of the frame: points, similarity, components, poses; then those of cameras."""
        return 3 * POINTS + 7 + COMPONENTS + (6 + VIEW) * len(self.joined)

    def parts(self, x: Float64) -> tuple[Float64, Float64, Float64, Float64, Float64]:
        views = len(self.joined)
        ends = np.cumsum([3 * POINTS, 7, COMPONENTS, 6 * views])
        points, similarity, z, poses, numbers = np.split(x, ends)
        return (
            self.points + points.reshape(-1, 3),
            similarity,
            z,
            poses.reshape(-1, 6),
            numbers.reshape(-1, VIEW) * np.r_[LENS_STEPS, np.ones(VIEW - LENS)],
        )

    def pixels(self, x: Float64) -> Float64:
        """Project the points (K, P, 2)."""
        points, _, _, poses, numbers = self.parts(x)
        found = np.empty((len(self.joined), POINTS, 2))
        for k, joined in enumerate(self.joined):
            offset = self.offsets[k] if joined else self.translations[k]
            own = numbers[k, LENS:] if joined else poses[k]
            in_rig = points @ self.rotations[k].T + self.translations[k] - offset
            turn = rotations_from_vectors(own[None, :3])[0]
            shift = (self.growth if joined else 1.0) * own[3:]
            camera = in_rig @ turn.T + offset + shift
            lens = self.lenses.of(np.array([k]))
            distortion = lens.distortion.copy()
            distortion[0, :2] += numbers[k, 3:LENS]
            changed = lens._replace(
                focals=lens.focals * np.exp(numbers[k, 0]),
                centres=lens.centres + numbers[k, 1:3],
                distortion=distortion,
            )
            found[k] = project(camera[None], changed)[0]
        return found

    def residuals(self, x: Float64) -> Float64:
        """All residuals in standard deviations: half their squares is minus the log posterior."""
        points, similarity, z, _, _ = self.parts(x)
        shape = self.shapes.mean + self.shapes.basis @ z
        expected = shape @ self.turned.T
        if self.joined.any():
            turn = rotations_from_vectors(similarity[None, 3:6])[0]
            expected = np.exp(similarity[6]) * expected @ turn.T + similarity[:3]
        scale = np.sqrt(np.square(self.turned).sum() / 3)
        of_shapes = (points - expected) / (scale * np.sqrt(self.shapes.variances))[:, None]
        of_keypoints = np.sqrt(self.weights)[..., None] * (self.pixels(x) - self.keypoints)
        return np.concatenate((of_keypoints.ravel(), of_shapes.ravel(), z))

    def frames(self) -> Frames:
        """Return the case as one frame."""
        return Frames(
            self.points[None],
            self.rotations[None],
            self.translations[None],
            self.lenses,
            self.joined[None],
            self.offsets[None],
            np.array([self.growth]),
            self.keypoints[None],
            self.weights[None],
            self.turned[None],
            np.zeros(1),
            np.ones((1, POINTS)),
        )

    def hessian(self) -> tuple[Float64, NDArray[np.bool_]]:
        """Return J^T J by central differences, and which numbers the frame has."""
        eye = STEP * np.eye(self.size)
        slopes = [(self.residuals(e) - self.residuals(-e)) / (2 * STEP) for e in eye]
        jacobian = np.stack(slopes, 1)
        there = np.ones(self.size, bool)
        there[3 * POINTS : 3 * POINTS + 7] = self.joined.any()
        first = 3 * POINTS + 7 + COMPONENTS
        poses = np.repeat(~self.joined, 6)
        there[first : first + len(poses)] = poses
        return jacobian.T @ jacobian, there


def without_gauge(points: Float64, size: int) -> Float64:
    """Return the projection (3 P, 3 P) off translations, rotations and, of seven, growth."""
    away = points - points.mean(0)
    turns = [np.cross(axis, away).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(points)) for axis in np.eye(3)]
    axes = np.linalg.qr(np.stack([*shifts, *turns, away.ravel()][:size], 1))[0]
    return np.asarray(np.eye(len(axes)) - axes @ axes.T)


def dense(found: Covariances, n: int) -> Float64:
    """Return the covariance (3 P, 3 P) of all coordinates of frame n."""
    columns = np.concatenate((found.modes[n], found.by_cameras[n]), -1)
    columns = columns.reshape(-1, columns.shape[-1])
    apart = 1 - block_diag(*np.ones((len(found.blocks[n]), 3, 3)))
    return np.asarray(block_diag(*found.blocks[n]) + columns @ columns.T * apart)


CASES = [[True, True, True], [True, True], [False, False, False], [True, True, False]]


@pytest.mark.parametrize("joined", CASES)
def test_information_on_cameras_is_what_eliminating_the_frame_leaves(joined: list[bool]) -> None:
    case = Case(joined)
    information, scores = scores_of(case.frames(), case.shapes)
    hessian, there = case.hessian()
    numbers = VIEW * len(joined)
    own = np.flatnonzero(there[: case.size - numbers])
    shared = np.arange(case.size - numbers, case.size)
    coupling = hessian[np.ix_(own, shared)]
    small = 1e-9 * np.eye(len(own))
    left = hessian[np.ix_(shared, shared)] - coupling.T @ np.linalg.solve(
        hessian[np.ix_(own, own)] + small, coupling
    )
    steps = np.tile(np.r_[LENS_STEPS, np.ones(VIEW - LENS)], len(joined))
    left = left / steps / steps[:, None]
    np.testing.assert_allclose(information, left, rtol=1e-3, atol=1e-4 * np.abs(left).max())
    assert np.abs(scores).max() == pytest.approx(0, abs=1e-9)
