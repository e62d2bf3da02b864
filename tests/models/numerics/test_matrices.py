"""Small matrices against NumPy and SciPy, degenerate ones included."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from models.numerics import matrices as algebra
from models.numerics import rotations
from models.numerics.compiled import compiled

Float64 = NDArray[np.float64]


@compiled
def inverse(a: Float64, out: Float64) -> None:
    algebra.inverse(a, out)


@compiled
def nearest_rotation_into(a: Float64, out: Float64) -> None:
    rotations.nearest_rotation_into(a, out)


@compiled
def nearest_orthonormal_rows_into(a: Float64, out: Float64) -> None:
    rotations.nearest_orthonormal_rows_into(a, out)


@compiled
def turn(vector: Float64, out: Float64) -> None:
    rotations.rotation_from_vector_into(vector[0], vector[1], vector[2], out)


@compiled
def solve(a: Float64, x: Float64) -> bool:
    if not algebra.cholesky(a):
        return False
    algebra.cholesky_solve(a, x)
    return True


def matrices() -> Iterator[Float64]:
    """Matrices (3, 3) of any rank and handedness."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        a = rng.standard_normal((3, 3)) * 10 ** rng.uniform(-3, 3)
        yield a
        yield np.stack((a[0], a[1], 2 * a[0]))  # of rank 2
        yield np.outer(a[0], a[1])  # of rank 1
        yield -Rotation.random(random_state=rng).as_matrix()  # three ways are equally near
    yield np.zeros((3, 3))


def check_rotation(found: Float64) -> None:
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1)


def test_the_nearest_turn_reaches_what_singular_values_allow() -> None:
    found = np.empty((3, 3))
    for a in matrices():
        nearest_rotation_into(a, found)
        check_rotation(found)
        u, values, vt = np.linalg.svd(a)
        values[2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
        assert (found * a).sum() == pytest.approx(values.sum(), rel=1e-9, abs=1e-12)


def test_the_nearest_rows_reach_what_singular_values_allow() -> None:
    found = np.empty((3, 3))
    for a in matrices():
        rows = a[:2] / max(np.abs(a).max(), 1e-3)
        nearest_orthonormal_rows_into(rows, found)
        check_rotation(found)
        best = np.linalg.svd(rows)[1].sum()
        assert (found[:2] * rows).sum() == pytest.approx(best, rel=1e-6, abs=1e-8)


def test_inverses_are_inverses() -> None:
    found = np.empty((3, 3))
    rng = np.random.default_rng(1)
    for _ in range(40):
        a = rng.standard_normal((3, 3))
        inverse(a, found)
        np.testing.assert_allclose(found, np.linalg.inv(a), rtol=1e-8)


@pytest.mark.parametrize("angle", [0, 1e-13, 1e-7, 0.3, np.pi, 7])
def test_turns_are_those_of_scipy(angle: float) -> None:
    found = np.empty((3, 3))
    vector = angle * np.array([0.36, -0.48, 0.8])
    turn(vector, found)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_definite_systems_are_solved_and_others_refused() -> None:
    rng = np.random.default_rng(2)
    for size in (1, 2, 17, 60):
        root = rng.standard_normal((size, size))
        a, x = root @ root.T + np.eye(size), rng.standard_normal(size)
        found = x.copy()
        assert solve(np.tril(a), found)  # the lower half is enough
        np.testing.assert_allclose(a @ found, x, rtol=1e-8, atol=1e-10)
        a[-1, -1] = -1
        assert not solve(a.copy(), x)
