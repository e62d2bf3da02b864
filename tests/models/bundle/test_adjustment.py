"""Adjustment against the same problem written out densely in NumPy and solved by SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from models.bundle.adjustment import adjust, move_rig, move_scene
from models.bundle.elimination import eliminate_frames
from models.bundle.frame_equations import NormalEquations, eliminate
from models.bundle.problem import (
    POSE,
    VIEW,
)
from models.bundle.separate_frames import adjust_frames, costs_of
from models.bundle.shared_likelihood import likelihood_of_shared
from models.bundle.structure_covariances import structure_covariances
from models.numerics.steps import finished
from tests.models.bundle.problems import (
    COMPONENTS,
    FRAMES,
    FREEDOM,
    OWN,
    POINTS,
    SIZE_PRECISION,
    TAILS,
    VIEWS,
    Float64,
    changed,
    dense,
    differences,
    jacobian,
    linearised,
    make,
    of,
    residuals,
    scales_of,
    whitened,
    without_components,
)
from tests.tiers import thorough_after


@pytest.mark.parametrize("stretched", [False, True])
@pytest.mark.parametrize("outliers", [False, True])
def test_the_cost_is_the_sum_of_the_squares(*, outliers: bool, stretched: bool) -> None:
    problem = make(outliers=outliers, stretched=stretched)
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


@pytest.mark.parametrize("stretched", [False, True])
@pytest.mark.parametrize(("heavy", "scale"), TAILS)
def test_the_gradient_agrees_with_differences_of_the_cost(
    *, heavy: bool, scale: float, stretched: bool
) -> None:
    problem = make(outliers=True, heavy=heavy, scale=scale, stretched=stretched)
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


@pytest.mark.parametrize("stretched", [False, True])
def test_the_normal_equations_are_those_of_the_residuals(*, stretched: bool) -> None:
    problem = make(off=0, stretched=stretched)
    rows = jacobian(problem, shared=True)
    lens = rows[-5 * VIEWS :]  # what is believed of the lenses: not the frames' business
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
    assert own.others.shape == (FRAMES, size, size)
    np.testing.assert_allclose(whole.others[:, :size, :size], own.others)
    np.testing.assert_allclose(whole.coupling[..., :size], own.coupling)
    np.testing.assert_allclose(whole.others_right[:, :size], own.others_right)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_eliminating_the_points_first_solves_the_dense_equations(damping: float) -> None:
    problem = make()
    normal = linearised(problem, shared=False)
    size = normal.others.shape[-1]
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


@pytest.mark.parametrize("outliers", thorough_after(1, [True, False]))
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
        covariance = block_diag(*found.blocks[frame])
        covariance += found.factors[frame] @ found.factors[frame].T
        np.testing.assert_allclose(covariance, expected, rtol=0, atol=1e-4 * size)


def test_a_frame_without_definite_equations_stays_and_does_not_count() -> None:
    problem = make()
    free, damping = problem.rig_prior.free, 1e-3
    equations = linearised(problem, shared=True)
    plain = eliminate_frames(equations, free, damping)
    equations.others[1] *= -1
    odd = eliminate_frames(equations, free, damping)
    for before, after in zip(plain, odd, strict=True):
        np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
        assert (after[1] == 0).all()


def test_adjusting_frames_and_rig_together_is_where_scipy_finds_the_optimum() -> None:
    problem = make()
    rig, scene = finished(
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
    prior, is_free = problem.rig_prior, problem.rig_prior.free
    found = likelihood_of_shared(problem.views, rig, problem.prior, scene, free=is_free)
    held = prior.precision[np.ix_(is_free, is_free)]
    ours = np.linalg.inv(found.curvature + held)
    np.testing.assert_allclose(np.diag(ours), np.diag(covariance), rtol=0.02)
    # At the optimum the keypoints pull as hard as what was believed before.
    pull = (prior.precision @ prior.offset(rig))[is_free]
    sds = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.score * sds, pull * sds, atol=0.02)
