"""The camera solution, compiled and in tensor operations, against SciPy; degenerate views too."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from models.network import reprojection_tensors
from models.network.reprojection_tensors import WeakPerspective, nearest_rotations, project
from models.numerics.compiled import compiled
from models.numerics.matrices import copy
from models.numerics.rotations import rotations_from_rows
from models.optics.weak_perspective import new_camera, solve_camera_into

Float64 = NDArray[np.float64]
Solver = Callable[[Tensor, Tensor, Tensor, Tensor], WeakPerspective]


@compiled
def _solve_each(
    points: Float64,
    image: Float64,
    weights: Float64,
    guesses: Float64,
    rotations: Float64,
    scales: Float64,
    translations: Float64,
) -> None:
    camera = new_camera()
    for n in range(len(points)):
        scales[n] = solve_camera_into(
            points[n], image[n], weights[n], weights[n].sum(), guesses[n], camera
        ).scale
        copy(camera.rotation, rotations[n])
        copy(camera.translation, translations[n])


def compiled_cameras(
    points: Tensor, image: Tensor, weights: Tensor, guesses: Tensor
) -> WeakPerspective:
    cameras = WeakPerspective(
        torch.empty(len(points), 3, 3).double(),
        torch.empty(len(points)).double(),
        torch.empty(len(points), 2).double(),
    )
    given = points, image, weights, guesses.contiguous(), *cameras
    _solve_each(*(part.double().numpy() for part in given))
    return cameras


both = pytest.mark.parametrize("solve", [compiled_cameras, reprojection_tensors.solve_cameras])


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


@pytest.mark.parametrize(
    "rows",
    [
        [[0.0, 0, 0], [0, 0, 0]],
        [[1.0, 2, 3], [2, 4, 6]],  # parallel
        [[-1.0, 2, 3], [2, -4, -6]],
        [[0.0, 0, 0], [1, 2, 3]],
        [[1e-20, 0, 0], [0, 1e-20, 0]],
        [[1.0, 1, 1], [1, 1, 1 + 1e-6]],
        [[0.0, 1, 0], [1, 0, 0]],  # equal singular values
        [[0.3, -2.0, 0.7], [1.1, 0.4, -0.2]],
    ],
)
def test_nearest_rotations_in_tensors_are_the_compiled_ones(rows: list[list[float]]) -> None:
    matrix = torch.tensor(rows, dtype=torch.float64, requires_grad=True)
    rotation = nearest_rotations(matrix)
    expected = rotations_from_rows(matrix.detach().numpy())
    np.testing.assert_allclose(rotation.detach(), expected, atol=1e-9)
    torch.autograd.backward(rotation[:2].sum())
    assert matrix.grad is not None
    assert matrix.grad.isfinite().all()


def test_nearest_rotations_agree_with_the_singular_value_decomposition() -> None:
    matrix = _random(0, 50, 2, 3)
    u, _, vt = np.linalg.svd(matrix.numpy(), full_matrices=False)
    for rotations in (rotations_from_rows(matrix.numpy()), nearest_rotations(matrix).numpy()):
        np.testing.assert_allclose(rotations[:, :2], u @ vt, atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(rotations), 1)


@both
def test_exact_projections_give_back_the_camera(solve: Solver) -> None:
    points, rotations = _random(1, 8, 12, 3), _rotations(2, 8)
    scales, translations = 1 + _random(3, 8).abs(), _random(4, 8, 2)
    image = project(points, WeakPerspective(rotations, scales, translations))
    weights = torch.ones(8, 12, dtype=torch.float64)
    weights[:, 3] = 0
    image[:, 3] = 1e3  # hidden: any number
    found = solve(points, image, weights, rotations)
    # The ridge of 1e-4 towards the guess is all that stands between the answer and the truth.
    assert (found.rotations - rotations).abs().max() < 1e-3
    np.testing.assert_allclose(found.scales, scales, rtol=1e-3)
    np.testing.assert_allclose(found.translations, translations, atol=2e-3)
    found = solve(points, image, weights, torch.eye(3).double().expand(8, 3, 3))
    assert (found.rotations - rotations).abs().max() < 1e-2


@both
def test_scale_and_translation_are_the_best_for_the_rotation(solve: Solver) -> None:
    points, image = _random(5, 1, 10, 3), _random(6, 1, 10, 2)
    weights = _random(7, 1, 10).abs()
    found = solve(points, image, weights, _rotations(8, 1))
    xy = (points @ found.rotations[:, :2].mT)[0].numpy()
    root = np.sqrt(weights[0].numpy())[:, None]

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.ravel(root * (x[0] * xy + x[1:] - image[0].numpy()))

    best = least_squares(residuals, np.array([1.0, 0, 0])).x
    np.testing.assert_allclose(found.scales[0], best[0], atol=1e-6)
    np.testing.assert_allclose(found.translations[0], best[1:], atol=1e-6)


@both
def test_the_rotation_is_the_one_nearest_to_the_affine_least_squares(solve: Solver) -> None:
    """With a solid structure, the ridge towards the guess hardly counts."""
    points, image = _random(5, 6, 10, 3), _random(6, 6, 10, 2)
    weights = _random(7, 6, 10).abs()
    found = solve(points, image, weights, _rotations(8, 6))
    for n in range(6):
        root = np.sqrt(weights[n].numpy())[:, None]
        system = root * np.concatenate((points[n].numpy(), np.ones((10, 1))), 1)
        affine = np.linalg.lstsq(system, root * image[n].numpy(), rcond=None)[0][:3].T
        u, _, vt = np.linalg.svd(affine, full_matrices=False)
        np.testing.assert_allclose(found.rotations[n, :2], u @ vt, atol=5e-3)


@both
def test_a_flat_structure_takes_its_depth_from_the_guess(solve: Solver) -> None:
    # All points in the plane z = 0: R and R with the third column negated project alike. The
    # solution without a ridge is 0 / 0 here.
    flat = _random(9, 1, 12, 3) * torch.tensor([1.0, 1.0, 0.0])
    rotation = _rotations(10, 1)
    camera = WeakPerspective(rotation, torch.ones(1).double(), torch.zeros(1, 2).double())
    image = project(flat, camera)
    found = solve(flat, image, torch.ones(1, 12).double(), rotation)
    assert (found.rotations - rotation).abs().max() < 0.01


def test_gradients_agree_with_finite_differences() -> None:
    points = _random(11, 2, 6, 3).requires_grad_()
    image, weights = _random(12, 2, 6, 2), _random(13, 2, 6).abs()
    guess = _rotations(14, 2)

    def error(x: Tensor) -> Tensor:
        return (
            (project(x, reprojection_tensors.solve_cameras(x, image, weights, guess)) - image)
            .square()
            .sum()
        )

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
    found = reprojection_tensors.solve_cameras(structure, image, weights, _rotations(17, 1).float())
    projected = project(structure, found)
    np.testing.assert_allclose(
        (found.rotations @ found.rotations.mT)[0].detach(), np.eye(3), atol=1e-4
    )
    torch.autograd.backward(projected.square().sum())
    assert projected.isfinite().all()
    assert points.grad is not None
    assert points.grad.isfinite().all()
