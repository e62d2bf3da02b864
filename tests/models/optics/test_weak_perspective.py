import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from models.optics.weak_perspective import WeakPerspective, nearest_rotation, project, solve_cameras


def _random(seed: int, *shape: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def _rotations(seed: int, count: int) -> Tensor:
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())


def test_projection_by_hand() -> None:
    # A quarter turn about z takes x to y: (1, 2, 3) -> (-2, 1, 3); times 10, plus (5, 6).
    turn = torch.from_numpy(Rotation.from_euler("z", 90, degrees=True).as_matrix())
    camera = WeakPerspective(turn, torch.tensor(10.0), torch.tensor([5.0, 6.0]))
    image = project(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64), camera)
    np.testing.assert_allclose(image, [[-15.0, 16.0]], atol=1e-12)


def test_nearest_rotation_agrees_with_the_singular_value_decomposition() -> None:
    matrix = _random(0, 50, 2, 3)
    rotations, stretch = nearest_rotation(matrix)
    u, s, vt = np.linalg.svd(matrix.numpy(), full_matrices=False)
    np.testing.assert_allclose(rotations[:, :2], u @ vt, atol=1e-9)
    np.testing.assert_allclose(stretch, s.mean(-1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)


@pytest.mark.parametrize(
    "rows",
    [
        [[0.0, 0, 0], [0, 0, 0]],
        [[1.0, 2, 3], [2, 4, 6]],  # parallel
        [[0.0, 0, 0], [1, 2, 3]],
        [[1e-20, 0, 0], [0, 1e-20, 0]],
        [[1.0, 1, 1], [1, 1, 1 + 1e-6]],
        [[0.0, 1, 0], [1, 0, 0]],  # equal singular values
    ],
)
def test_nearest_rotation_of_degenerate_rows_is_a_rotation_with_finite_gradient(
    rows: list[list[float]],
) -> None:
    matrix = torch.tensor(rows, requires_grad=True)
    rotation, stretch = nearest_rotation(matrix)
    np.testing.assert_allclose((rotation @ rotation.mT).detach(), np.eye(3), atol=1e-5)
    assert torch.linalg.det(rotation).item() == pytest.approx(1, abs=1e-5)
    torch.autograd.backward(rotation.sum() + stretch.sum())
    assert matrix.grad is not None
    assert matrix.grad.isfinite().all()


def test_exact_projections_give_back_the_camera() -> None:
    points, rotations = _random(1, 8, 12, 3), _rotations(2, 8)
    scales, translations = 1 + _random(3, 8).abs(), _random(4, 8, 2)
    image = project(points, WeakPerspective(rotations, scales, translations))
    weights = torch.ones(8, 12, dtype=torch.float64)
    weights[:, 3] = 0
    image[:, 3] = 1e3  # hidden: any number
    found = solve_cameras(points, image, weights, rotations)
    # The ridge of 1e-4 towards the guess is all that stands between the answer and the truth.
    assert (found.rotations - rotations).abs().max() < 1e-3
    np.testing.assert_allclose(found.scales, scales, rtol=1e-3)
    np.testing.assert_allclose(found.translations, translations, atol=2e-3)
    found = solve_cameras(points, image, weights, torch.eye(3).double().expand(8, 3, 3))
    assert (found.rotations - rotations).abs().max() < 1e-2


def test_scale_and_translation_are_the_best_for_the_rotation() -> None:
    points, image = _random(5, 1, 10, 3), _random(6, 1, 10, 2)
    weights = _random(7, 1, 10).abs()
    found = solve_cameras(points, image, weights, _rotations(8, 1))
    xy = (points @ found.rotations[:, :2].mT)[0].numpy()
    root = np.sqrt(weights[0].numpy())[:, None]

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.ravel(root * (x[0] * xy + x[1:] - image[0].numpy()))

    best = least_squares(residuals, np.array([1.0, 0, 0])).x
    np.testing.assert_allclose(found.scales[0], best[0], atol=1e-6)
    np.testing.assert_allclose(found.translations[0], best[1:], atol=1e-6)


def test_a_flat_structure_takes_its_depth_turn_from_the_guess() -> None:
    # All points in the plane z = 0: R and R with the third column negated project alike. The
    # solution without a ridge is 0 / 0 here.
    flat = _random(9, 1, 12, 3) * torch.tensor([1.0, 1.0, 0.0])
    rotation = _rotations(10, 1)
    camera = WeakPerspective(rotation, torch.ones(1).double(), torch.zeros(1, 2).double())
    image = project(flat, camera)
    found = solve_cameras(flat, image, torch.ones(1, 12).double(), rotation)
    assert (found.rotations - rotation).abs().max() < 0.01


def test_gradients_agree_with_finite_differences() -> None:
    points = _random(11, 2, 6, 3).requires_grad_()
    image, weights = _random(12, 2, 6, 2), _random(13, 2, 6).abs()
    guess = _rotations(14, 2)

    def error(x: Tensor) -> Tensor:
        return (project(x, solve_cameras(x, image, weights, guess)) - image).square().sum()

    assert torch.autograd.gradcheck(error, (points,))


@pytest.mark.parametrize("case", ["no weight", "one place", "line", "collapsed structure"])
def test_degenerate_views_stay_finite_and_rotations_stay_rotations(case: str) -> None:
    points = _random(15, 1, 8, 3).float().requires_grad_()
    image, weights = _random(16, 1, 8, 2).float(), torch.ones(1, 8)
    if case == "no weight":
        weights = torch.zeros(1, 8)
    elif case == "one place":
        image = torch.full((1, 8, 2), 3.0)
    elif case == "line":
        image = image * torch.tensor([1.0, 0.0])
    structure = points * 0 if case == "collapsed structure" else points
    found = solve_cameras(structure, image, weights, _rotations(17, 1).float())
    projected = project(structure, found)
    np.testing.assert_allclose(
        (found.rotations @ found.rotations.mT)[0].detach(), np.eye(3), atol=1e-4
    )
    torch.autograd.backward(projected.square().sum())
    assert projected.isfinite().all()
    assert points.grad is not None
    assert points.grad.isfinite().all()
