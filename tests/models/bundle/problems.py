"""A small problem of bundle adjustment, and its cost and equations computed in the plainest way."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.bundle.adjustment import RigPrior, move_rig
from models.bundle.frame_equations import NormalEquations
from models.bundle.problem import (
    POSE,
    VIEW,
    Rig,
    Scene,
    ShapePrior,
    Views,
    make_rig,
    make_shape_prior,
)
from models.bundle.separate_frames import costs_of, normal_equations
from models.optics.lenses.projection import Lenses

Float64 = NDArray[np.float64]

FRAMES, POINTS, COMPONENTS = 3, 6, 2
GROUPS = (0, 0, 1, 0)  # a rig of three, and a camera that moves
VIEWS = len(GROUPS)
OWN = 3 * POINTS + POSE * 2  # unknowns of a frame: its points, and a pose per group
NOISE = 1.5  # pixels
SPREAD = 0.05  # of structures beside the components
SIZE_PRECISION = np.array([1 / 0.3**2, 1e8])  # inverse variances of the groups' log sizes
OF_STRETCH = np.array([1 / 0.3**2, 1 / 0.3**2])  # if the view that moves is stretched
HUBER = 3.0  # standard deviations
FREEDOM = 3 * POINTS - 7  # of a structure, similarities aside
TAILS = [(False, 1.0), (True, 1.0), (True, 8.0), (True, 0.3)]  # heavy ones, with a scale
MISSING = ((0, 0, 2), (0, 3, 5), (1, 2), (2, 1))  # two keypoints, the moving view, one of the rig


@dataclass(frozen=True)
class CalibrationProblem:
    """A capture of known cameras, and a start some way off."""

    views: Views
    rig: Rig
    prior: ShapePrior
    scene: Scene
    rig_prior: RigPrior


def about(rng: np.random.Generator, shape: tuple[int, ...], degrees: float) -> Float64:
    """Draw rotations that turn by about so many degrees."""
    vectors = np.deg2rad(degrees) * rng.standard_normal((*shape, 3))
    turned: Float64 = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return turned.reshape(*shape, 3, 3)


def make(
    *,
    off: float = 1.0,
    outliers: bool = False,
    heavy: bool = False,
    scale: float = 1.0,
    stretched: bool = False,
    seed: int = 0,
) -> CalibrationProblem:
    """Make a capture, and a start that is `off` by some degrees and tenths.

    The images of the camera that moves may be `stretched`.
    """
    rng = np.random.default_rng(seed)
    basis = 0.15 * rng.standard_normal((POINTS, 3, COMPONENTS))
    mean = rng.standard_normal((POINTS, 3))
    points = mean + np.einsum("piq,nq->npi", basis, rng.standard_normal((FRAMES, COMPONENTS)))
    points += 0.05 * rng.standard_normal(points.shape)

    # Cameras of the rig on an arc, three metres or so from its origin; the first is the origin.
    extrinsics = np.stack([np.eye(3)] * VIEWS)
    shifts = np.zeros((VIEWS, 3))
    for view, angle in ((1, 50.0), (3, -70.0)):
        extrinsics[view] = Rotation.from_euler("yx", [angle, 5], degrees=True).as_matrix()
        shifts[view] = np.array([0, 0, 7.0]) - extrinsics[view] @ np.array([0, 0, 7.0])
    rotations = about(rng, (FRAMES, 2), 60)
    translations = np.array([0, 0, 7.0]) + 0.3 * rng.standard_normal((FRAMES, 2, 3))
    sizes = np.stack((0.2 * rng.standard_normal(FRAMES), np.zeros(FRAMES)), -1)
    if stretched:
        sizes[:, 1] = 0.2 * rng.standard_normal(FRAMES)
    distortion = np.zeros((VIEWS, 8))
    distortion[:, :2] = [[-0.08, 0.02], [0.03, 0.0], [0.0, 0.0], [-0.05, 0.0]]
    rig = make_rig(
        Lenses(
            rng.uniform(900, 1300, (VIEWS, 2)),
            rng.uniform(400, 600, (VIEWS, 2)),
            distortion,
            np.zeros(VIEWS, np.int8),
        ),
        np.array(GROUPS),
        extrinsics,
        shifts,
        np.array([False, False, stretched, False]),
    )
    truth = Scene(points, rotations, translations, sizes)
    # Never so much noise that a keypoint counts as an outlier.
    keypoints = pixels_of(truth, rig) + NOISE * rng.uniform(-1.7, 1.7, (FRAMES, VIEWS, POINTS, 2))
    if outliers:
        keypoints[0, 1, 3] += 40
        keypoints[2, 3, 0] -= 25
    weights = rng.uniform(0.3, 1, keypoints.shape[:3]) / NOISE**2
    for place in MISSING:
        keypoints[place] = 1e4  # whatever stands where nothing was seen
        weights[place] = 0

    start = Scene(
        points + 0.1 * off * rng.standard_normal(points.shape),
        about(rng, (FRAMES, 2), 4 * off) @ rotations,
        translations + 0.1 * off * rng.standard_normal(translations.shape),
        sizes + np.array([0.05 * off, 0.1 * off * stretched]),
    )
    bias = 0.02 * rng.standard_normal((VIEWS, VIEW))
    bias[:, 1:3] *= 100
    reference = move_rig(rig, bias.ravel())
    precision = np.tile(
        [1 / 0.3**2, 1 / 20**2, 1 / 20**2, 1 / 0.2**2, 1 / 0.1**2, *[0.0] * 6], VIEWS
    )
    free = np.ones((VIEWS, VIEW), bool)
    free[0, 5:] = free[2, 5:] = False  # the frames of reference of the groups
    free[2, 1:3] = False
    return CalibrationProblem(
        Views(keypoints, weights),
        rig,
        make_shape_prior(np.stack([mean] * FRAMES), basis, SPREAD, scale=scale, heavy=heavy),
        start,
        RigPrior(rig._replace(lenses=reference.lenses), np.diag(precision), free.ravel()),
    )


def pixels_of(scene: Scene, rig: Rig) -> Float64:
    """Project with a plain pinhole whose radial distortion has two coefficients."""
    pixels = np.empty((FRAMES, VIEWS, POINTS, 2))
    points, rotations, translations, sizes = scene
    for n, k in np.ndindex(FRAMES, VIEWS):
        g = GROUPS[k]
        if rig.stretched[k]:
            held = points[n] @ rotations[n, g].T + translations[n, g]
            held = held * [np.exp(sizes[n, g]), 1, 1]
        else:
            held = np.exp(sizes[n, g]) * points[n] @ rotations[n, g].T + translations[n, g]
        x = held @ rig.rotations[k].T + rig.translations[k]
        flat = x[:, :2] / x[:, 2:]
        k1, k2 = rig.lenses.distortion[k, :2]
        squared = np.square(flat).sum(-1, keepdims=True)
        bent = flat * (1 + k1 * squared + k2 * squared**2)
        pixels[n, k] = rig.lenses.focals[k] * bent + rig.lenses.centres[k]
    return pixels


def changed(problem: CalibrationProblem, step: Float64) -> tuple[Scene, Rig]:
    """Apply numbers of frames (N, 32), and of the rig (44,) if there are more."""
    frames, shared = step[: FRAMES * OWN].reshape(FRAMES, OWN), step[FRAMES * OWN :]
    old, rig = problem.scene, problem.rig
    pose = frames[:, 3 * POINTS :].reshape(FRAMES, 2, POSE)
    turns = Rotation.from_rotvec(pose[..., :3].reshape(-1, 3)).as_matrix()
    scene = Scene(
        old.points + frames[:, : 3 * POINTS].reshape(FRAMES, POINTS, 3),
        turns.reshape(FRAMES, 2, 3, 3) @ old.rotations,
        old.translations + pose[..., 3:6],
        old.sizes + pose[..., 6],
    )
    if not len(shared):
        return scene, rig
    view = shared.reshape(VIEWS, VIEW)
    distortion = rig.lenses.distortion.copy()
    distortion[:, :2] += view[:, 3:5]
    lenses = rig.lenses._replace(
        focals=rig.lenses.focals * np.exp(view[:, :1]),
        centres=rig.lenses.centres + view[:, 1:3],
        distortion=distortion,
    )
    turns = Rotation.from_rotvec(view[:, 5:8]).as_matrix()
    return scene, rig._replace(
        lenses=lenses,
        rotations=turns @ rig.rotations,
        translations=rig.translations + view[:, 8:],
    )


def residuals(problem: CalibrationProblem, step: Float64) -> Float64:
    """Return what squared and summed is the cost of all frames, and of the rig if it may change."""
    scene, rig = changed(problem, step)
    root = np.sqrt(problem.views.weights)[..., None]
    error = root * (pixels_of(scene, rig) - problem.views.keypoints)
    size = np.maximum(np.linalg.norm(error, axis=-1, keepdims=True), 1e-12)
    outside = 2 * HUBER * np.maximum(size, HUBER) - HUBER**2
    robust = np.where(size > HUBER, np.sqrt(outside), size)
    parts = [error * robust / size]

    parts += [
        whitened(problem.prior, scene) / scales_of(problem)[:, None],
        np.sqrt(OF_STRETCH if rig.stretched[2] else SIZE_PRECISION) * scene.sizes,
    ]
    if len(step) > FRAMES * OWN:
        ours, mean = rig.lenses, problem.rig_prior.mean.lenses
        lens = np.concatenate(
            (
                np.log(ours.focals / mean.focals).mean(-1, keepdims=True),
                (ours.centres - mean.centres),
                (ours.distortion - mean.distortion)[:, :2],
            ),
            -1,
        )
        held = np.diag(problem.rig_prior.precision).reshape(VIEWS, VIEW)[:, :5]
        parts.append(np.sqrt(held) * lens)
    return np.concatenate([part.ravel() for part in parts])


def whitened(prior: ShapePrior, scene: Scene) -> Float64:
    """Offsets from the mean, (N, 3 P), that are independent and of variance 1 for scale 1."""
    covariance = prior.basis @ prior.basis.T + prior.spread**2 * np.eye(3 * POINTS)
    offset: Float64 = (scene.points - prior.means).reshape(FRAMES, -1)
    independent: Float64 = offset @ np.linalg.cholesky(np.linalg.inv(covariance))
    return independent


def scales_of(problem: CalibrationProblem) -> Float64:
    """Scales of the prior, (N,): with heavy tails those that a frame's structure asks for."""
    scales = np.full(FRAMES, problem.prior.scale)
    if not problem.prior.heavy:
        return scales
    squared = np.square(whitened(problem.prior, problem.scene)).sum(1)
    wider: Float64 = np.maximum(scales, np.sqrt(squared / FREEDOM))
    return wider


def differences(function: Callable[[Float64], Float64], size: int, step: float = 1e-6) -> Float64:
    """Central differences at 0: a column for each of `size` numbers."""
    unit = step * np.eye(size)
    return np.stack([(function(e) - function(-e)) / (2 * step) for e in unit], -1)


def jacobian(problem: CalibrationProblem, *, shared: bool) -> Float64:
    size = FRAMES * OWN + (VIEW * VIEWS if shared else 0)
    return differences(lambda step: residuals(problem, step), size)


def linearised(problem: CalibrationProblem, *, shared: bool) -> NormalEquations:
    return normal_equations(problem.views, problem.rig, problem.prior, problem.scene, shared=shared)


def dense(normal: NormalEquations, frame: int) -> tuple[Float64, Float64]:
    """Matrix and right-hand side of one frame: points, then poses, components, what is shared."""
    rest = normal.others.shape[-1]
    matrix = np.zeros((3 * POINTS + rest,) * 2)
    for p in range(POINTS):
        mine = slice(3 * p, 3 * p + 3)
        matrix[mine, mine] = normal.points[frame, p]
    coupling = normal.coupling[frame].reshape(3 * POINTS, rest)
    matrix[: 3 * POINTS, 3 * POINTS :] = coupling
    matrix[3 * POINTS :, : 3 * POINTS] = coupling.T
    matrix[3 * POINTS :, 3 * POINTS :] = normal.others[frame]
    pull = np.concatenate((normal.points_right[frame].ravel(), normal.others_right[frame]))
    return matrix, pull


def without_components(matrix: Float64, pull: Float64) -> tuple[Float64, Float64]:
    """Eliminate the components of the shape, which stand after the poses."""
    gone = np.arange(OWN, OWN + COMPONENTS)
    kept = np.setdiff1d(np.arange(len(matrix)), gone)
    carried = matrix[np.ix_(kept, gone)] @ np.linalg.inv(matrix[np.ix_(gone, gone)])
    return (
        matrix[np.ix_(kept, kept)] - carried @ matrix[np.ix_(gone, kept)],
        pull[kept] - carried @ pull[gone],
    )


def of(problem: CalibrationProblem, scene: Scene, rig: Rig) -> Float64:
    return costs_of(problem.views, rig, problem.prior, scene)
