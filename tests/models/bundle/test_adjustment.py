"""Adjustment against the same problem written out densely in NumPy and solved by SciPy."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from models.bundle.adjustment import RigPrior, adjust, move_rig, move_scene
from models.bundle.elimination import eliminate_frames
from models.bundle.frame_equations import NormalEquations, eliminate
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
from models.bundle.scene_adjustment import adjust_frames, costs_of, normal_equations
from models.bundle.structure_covariances import structure_covariances
from models.optics.lenses.projection import Lenses

Float64 = NDArray[np.float64]
T = TypeVar("T")

FRAMES, POINTS, COMPONENTS = 3, 6, 2
GROUPS = (0, 0, 1, 0)  # a rig of three, and a camera that moves
VIEWS = len(GROUPS)
OWN = 3 * POINTS + POSE * 2  # unknowns of a frame: its points, and a pose per group
NOISE = 1.5  # pixels
SPREAD = 0.05  # of structures beside the components
SIZE_PRECISION = np.array([1 / 0.3**2, 1e8])  # inverse variances of the groups' log sizes
HUBER = 3.0  # standard deviations
FREEDOM = 3 * POINTS - 7  # of a structure, similarities aside
TAILS = [(False, 1.0), (True, 1.0), (True, 8.0), (True, 0.3)]  # heavy ones, with a scale
MISSING = ((0, 0, 2), (0, 3, 5), (1, 2), (2, 1))  # two keypoints, the moving view, one of the rig


@dataclass(frozen=True)
class Problem:
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
    seed: int = 0,
) -> Problem:
    """Make a capture, and a start that is `off` by some degrees and tenths."""
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
        sizes + np.array([0.05 * off, 0]),
    )
    bias = 0.02 * rng.standard_normal((VIEWS, VIEW))
    bias[:, 1:3] *= 100
    reference = move_rig(rig, bias.ravel())
    precision = np.tile([1 / 0.3**2, 1 / 20**2, 1 / 20**2, 1 / 0.2**2, *[0.0] * 6], VIEWS)
    free = np.ones((VIEWS, VIEW), bool)
    free[0, 4:] = free[2, 4:] = False  # the frames of reference of the groups
    free[2, 1:3] = False
    return Problem(
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
        held = np.exp(sizes[n, g]) * points[n] @ rotations[n, g].T + translations[n, g]
        x = held @ rig.rotations[k].T + rig.translations[k]
        flat = x[:, :2] / x[:, 2:]
        k1, k2 = rig.lenses.distortion[k, :2]
        squared = np.square(flat).sum(-1, keepdims=True)
        bent = flat * (1 + k1 * squared + k2 * squared**2)
        pixels[n, k] = rig.lenses.focals[k] * bent + rig.lenses.centres[k]
    return pixels


def changed(problem: Problem, step: Float64) -> tuple[Scene, Rig]:
    """Apply numbers of frames (N, 32), and of the rig (40,) if there are more."""
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
    distortion[:, 0] += view[:, 3]
    lenses = rig.lenses._replace(
        focals=rig.lenses.focals * np.exp(view[:, :1]),
        centres=rig.lenses.centres + view[:, 1:3],
        distortion=distortion,
    )
    turns = Rotation.from_rotvec(view[:, 4:7]).as_matrix()
    return scene, rig._replace(
        lenses=lenses,
        rotations=turns @ rig.rotations,
        translations=rig.translations + view[:, 7:],
    )


def residuals(problem: Problem, step: Float64) -> Float64:
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
        np.sqrt(SIZE_PRECISION) * scene.sizes,
    ]
    if len(step) > FRAMES * OWN:
        ours, mean = rig.lenses, problem.rig_prior.mean.lenses
        lens = np.concatenate(
            (
                np.log(ours.focals / mean.focals).mean(-1, keepdims=True),
                (ours.centres - mean.centres),
                (ours.distortion - mean.distortion)[:, :1],
            ),
            -1,
        )
        held = np.diag(problem.rig_prior.precision).reshape(VIEWS, VIEW)[:, :4]
        parts.append(np.sqrt(held) * lens)
    return np.concatenate([part.ravel() for part in parts])


def whitened(prior: ShapePrior, scene: Scene) -> Float64:
    """Offsets from the mean, (N, 3 P), that are independent and of variance 1 for scale 1."""
    covariance = prior.basis @ prior.basis.T + prior.spread**2 * np.eye(3 * POINTS)
    offset: Float64 = (scene.points - prior.means).reshape(FRAMES, -1)
    independent: Float64 = offset @ np.linalg.cholesky(np.linalg.inv(covariance))
    return independent


def scales_of(problem: Problem) -> Float64:
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


def jacobian(problem: Problem, *, shared: bool) -> Float64:
    size = FRAMES * OWN + (VIEW * VIEWS if shared else 0)
    return differences(lambda step: residuals(problem, step), size)


def linearised(problem: Problem, *, shared: bool) -> NormalEquations:
    return normal_equations(problem.views, problem.rig, problem.prior, problem.scene, shared=shared)


def dense(normal: NormalEquations, frame: int) -> tuple[Float64, Float64]:
    """Matrix and right-hand side of one frame: points, then poses, components, what is shared."""
    rest = normal.rest.shape[-1]
    matrix = np.zeros((3 * POINTS + rest,) * 2)
    for p in range(POINTS):
        mine = slice(3 * p, 3 * p + 3)
        matrix[mine, mine] = normal.points[frame, p]
    coupling = normal.coupling[frame].reshape(3 * POINTS, rest)
    matrix[: 3 * POINTS, 3 * POINTS :] = coupling
    matrix[3 * POINTS :, : 3 * POINTS] = coupling.T
    matrix[3 * POINTS :, 3 * POINTS :] = normal.rest[frame]
    pull = np.concatenate((normal.points_right[frame].ravel(), normal.rest_right[frame]))
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


def finished(steps: Generator[None, None, T]) -> T:
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            value: T = stop.value
            return value


def of(problem: Problem, scene: Scene, rig: Rig) -> Float64:
    return costs_of(problem.views, rig, problem.prior, scene)


@pytest.mark.parametrize("outliers", [False, True])
def test_the_cost_is_the_sum_of_the_squares(*, outliers: bool) -> None:
    problem = make(outliers=outliers)
    found = of(problem, problem.scene, problem.rig)
    squares = np.square(residuals(problem, np.zeros(FRAMES * OWN)))
    assert found.sum() == pytest.approx(squares.sum(), rel=1e-10)


@pytest.mark.parametrize(("scale", "asks_for_more"), [(1.0, True), (8.0, False), (0.3, True)])
def test_heavy_tails_are_the_best_of_all_wider_gaussians(
    *, scale: float, asks_for_more: bool
) -> None:
    problem = make(heavy=True, scale=scale)
    blind = replace(
        problem, views=problem.views._replace(weights=np.zeros_like(problem.views.weights))
    )
    sizes = (SIZE_PRECISION * np.square(problem.scene.sizes)).sum(1)
    found = costs_of(blind.views, blind.rig, blind.prior, blind.scene) - sizes
    normal = linearised(blind, shared=False)
    squared = np.square(whitened(problem.prior, problem.scene)).sum(1)
    for frame in range(FRAMES):
        wider = scale * np.geomspace(1, 100, 100_001)
        costs = squared[frame] / wider**2 + 2 * FREEDOM * np.log(wider / scale)
        best = wider[costs.argmin()]
        assert float(found[frame]) == pytest.approx(costs.min(), rel=1e-6)
        inverse = 1 / (best * problem.prior.spread) ** 2
        np.testing.assert_allclose(normal.points[frame], [inverse * np.eye(3)] * POINTS, rtol=1e-3)
        offset = problem.scene.points[frame] - problem.prior.means[frame]
        along = -float((normal.points_right[frame] * offset).sum())
        assert along == pytest.approx(squared[frame] / best**2, rel=1e-3)
    assert set(scales_of(problem) > scale) == {asks_for_more}  # the side of the bound


@pytest.mark.parametrize(("heavy", "scale"), TAILS)
def test_the_gradient_agrees_with_differences_of_the_cost(*, heavy: bool, scale: float) -> None:
    problem = make(outliers=True, heavy=heavy, scale=scale)
    normal = linearised(problem, shared=True)
    size = 3 * POINTS + POSE * 2
    none = np.zeros((FRAMES, VIEW * VIEWS))

    def shifted(step: Float64) -> Float64:
        x = np.tile(step, (FRAMES, 1))
        scene = move_scene(
            problem.scene,
            x[:, : 3 * POINTS].reshape(FRAMES, POINTS, 3),
            np.concatenate((x[:, 3 * POINTS : size], none), -1),
        )
        return of(problem, scene, move_rig(problem.rig, x[0, size:]))

    slopes = differences(shifted, size + VIEW * VIEWS)  # (N, ...)
    for frame in range(FRAMES):
        _, pull = without_components(*dense(normal, frame))
        np.testing.assert_allclose(-2 * pull, slopes[frame], rtol=1e-5, atol=1e-3)


def test_the_normal_equations_are_those_of_the_residuals() -> None:
    problem = make(off=0)
    rows = jacobian(problem, shared=True)
    lens = rows[-4 * VIEWS :]  # what is believed of the lenses: not the frames' business
    matrix = rows.T @ rows - lens.T @ lens
    normal = linearised(problem, shared=True)
    total = np.zeros((VIEW * VIEWS,) * 2)
    for frame in range(FRAMES):
        found, _ = without_components(*dense(normal, frame))
        mine = slice(OWN * frame, OWN * (frame + 1))
        scale = np.sqrt(np.abs(np.diag(found)).clip(1e-6))
        scale = np.outer(scale, scale)
        rest = slice(FRAMES * OWN, None)
        np.testing.assert_allclose(
            found[:OWN, :OWN] / scale[:OWN, :OWN], matrix[mine, mine] / scale[:OWN, :OWN], atol=1e-6
        )
        np.testing.assert_allclose(
            found[:OWN, OWN:] / scale[:OWN, OWN:], matrix[mine, rest] / scale[:OWN, OWN:], atol=1e-6
        )
        total += found[OWN:, OWN:]
    np.testing.assert_allclose(total, matrix[rest, rest], rtol=1e-5, atol=1e-2)


def test_a_frame_without_what_is_shared_has_the_same_equations() -> None:
    problem = make()
    size = POSE * 2 + COMPONENTS
    whole, own = linearised(problem, shared=True), linearised(problem, shared=False)
    assert own.rest.shape == (FRAMES, size, size)
    np.testing.assert_allclose(whole.rest[:, :size, :size], own.rest)
    np.testing.assert_allclose(whole.coupling[..., :size], own.coupling)
    np.testing.assert_allclose(whole.rest_right[:, :size], own.rest_right)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_eliminating_the_points_first_solves_the_dense_equations(damping: float) -> None:
    problem = make()
    normal = linearised(problem, shared=False)
    size = normal.rest.shape[-1]
    inverse, reduced, right = np.empty((POINTS, 3, 3)), np.empty((size, size)), np.empty(size)
    for frame in (0, 2):  # without the moving camera, the second frame leaves its pose open
        own = NormalEquations(*(a[frame] for a in normal))
        eliminate(own, damping, inverse, reduced, right)
        whole = np.tril(reduced) + np.tril(reduced, -1).T
        matrix, pull = dense(normal, frame)
        expected = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), pull)
        rest = np.asarray(np.linalg.solve(whole, right), np.float64)
        left = normal.points_right[frame] - normal.coupling[frame] @ rest
        points = (inverse @ left[..., None]).ravel()
        np.testing.assert_allclose(rest, expected[3 * POINTS :], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(points, expected[: 3 * POINTS], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("outliers", [False, True])
def test_refined_frames_are_where_scipy_finds_the_optimum(*, outliers: bool) -> None:
    problem = make(outliers=outliers)
    scene, costs = adjust_frames(
        problem.views,
        problem.rig,
        problem.prior,
        problem.scene,
        iterations=100,
    )

    def error(step: Float64) -> Float64:
        return residuals(problem, step)

    best = least_squares(error, np.zeros(FRAMES * OWN), x_scale="jac", xtol=1e-12, ftol=1e-12)
    expected, _ = changed(problem, best.x)
    assert float(costs.sum()) == pytest.approx(2 * best.cost, rel=1e-5)
    assert float(costs.sum()) < 0.2 * of(problem, problem.scene, problem.rig).sum()
    np.testing.assert_allclose(scene.points, expected.points, atol=3e-4)
    there = np.array([[True, True], [True, False], [True, True]])  # group, in frame
    for found, wanted in zip(scene[1:], expected[1:], strict=True):
        np.testing.assert_allclose(found[there], wanted[there], atol=3e-3)


def test_every_frame_is_refined_on_its_own() -> None:
    problem = make(outliers=True)
    together = adjust_frames(
        problem.views,
        problem.rig,
        problem.prior,
        problem.scene,
    )
    for frame in range(FRAMES):
        part = slice(frame, frame + 1)
        alone = adjust_frames(
            problem.views.of(part),
            problem.rig,
            problem.prior.of(part),
            problem.scene.of(part),
        )
        np.testing.assert_allclose(alone[1], together[1][part])
        np.testing.assert_allclose(alone[0].points, together[0].points[part])


def test_a_frame_behind_a_camera_has_no_cost_and_stays() -> None:
    problem = make()
    translations = problem.scene.translations.copy()
    translations[1, 0, 2] *= -1
    start = problem.scene._replace(translations=translations)
    scene, costs = adjust_frames(problem.views, problem.rig, problem.prior, start)
    assert np.isfinite(costs).tolist() == [True, False, True]
    np.testing.assert_allclose(scene.points[1], start.points[1], rtol=0, atol=0)
    assert not np.array_equal(scene.points[0], start.points[0])


@pytest.mark.parametrize(("heavy", "scale"), TAILS)
def test_covariances_are_the_inverse_of_the_dense_equations(*, heavy: bool, scale: float) -> None:
    problem = make(off=0, heavy=heavy, scale=scale)
    found = structure_covariances(problem.views, problem.rig, problem.prior, problem.scene)
    rows = jacobian(problem, shared=False)
    matrix = rows.T @ rows
    for frame in range(FRAMES):
        mine = slice(OWN * frame, OWN * (frame + 1))
        inverse = np.linalg.pinv(matrix[mine, mine], hermitian=True)
        expected = inverse[: 3 * POINTS, : 3 * POINTS]
        size = np.abs(expected).max()
        np.testing.assert_allclose(found[frame], expected, rtol=0, atol=1e-4 * size)


def test_a_frame_without_definite_equations_says_nothing_and_stays() -> None:
    problem = make()
    free, damping = problem.rig_prior.free, 1e-3
    equations = linearised(problem, shared=True)
    plain = eliminate_frames(equations, free, damping)
    equations.rest[1] *= -1
    odd = eliminate_frames(equations, free, damping)
    for before, after in zip(plain, odd, strict=True):
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        assert (after[1] == 0).all()


def test_adjusting_frames_and_rig_together_is_where_scipy_finds_the_optimum() -> None:
    problem = make()
    rig, scene, information = finished(
        adjust(
            problem.views,
            problem.rig,
            problem.prior,
            problem.scene,
            rig_prior=problem.rig_prior,
            iterations=200,
        )
    )
    free = np.concatenate((np.ones(FRAMES * OWN, bool), problem.rig_prior.free))

    def full(step: Float64) -> Float64:
        every = np.zeros(len(free))
        every[free] = step
        return every

    def error(step: Float64) -> Float64:
        return residuals(problem, full(step))

    best = least_squares(error, np.zeros(free.sum()), x_scale="jac", xtol=1e-12, ftol=1e-12)
    expected_scene, expected = changed(problem, full(best.x))
    total = of(problem, scene, rig).sum() + problem.rig_prior.cost(rig)
    assert total == pytest.approx(2 * best.cost, rel=1e-5)
    np.testing.assert_allclose(scene.points, expected_scene.points, atol=1e-3)
    np.testing.assert_allclose(rig.lenses.focals, expected.lenses.focals, rtol=2e-3)
    np.testing.assert_allclose(rig.lenses.centres, expected.lenses.centres, atol=0.5)
    np.testing.assert_allclose(rig.lenses.distortion, expected.lenses.distortion, atol=2e-3)
    np.testing.assert_allclose(rig.rotations, expected.rotations, atol=1e-3)
    np.testing.assert_allclose(rig.translations, expected.translations, atol=1e-2)

    kept = ~problem.rig_prior.free.reshape(VIEWS, VIEW)
    assert (rig.lenses.centres[kept[:, 1]] == problem.rig.lenses.centres[kept[:, 1]]).all()
    still = kept[:, 4]
    assert (rig.rotations[still] == problem.rig.rotations[still]).all()
    assert (rig.translations[still] == problem.rig.translations[still]).all()

    rest = slice(FRAMES * OWN, None)
    rows: Float64 = np.asarray(best.jac)
    covariance = np.linalg.pinv(rows.T @ rows, hermitian=True)[rest, rest]
    ours = np.linalg.inv(information)
    np.testing.assert_allclose(np.diag(ours), np.diag(covariance), rtol=0.02)
