"""Lengths, angles and ratios with their deviations: by differences, dense algebra and draws."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fewview import Lift
from fewview.measures import Measured
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

FRAMES, POINTS, MODES = 4, 6, 12
PAIRS = [(0, 1), (4, 2), (5, 0)]
TRIPLES = [(0, 1, 2), (3, 5, 1)]
RATIOS = [((0, 1), (2, 3)), ((0, 1), (1, 2)), ((4, 5), (5, 4)), ((3, 4), (3, 5))]
UPPER = np.triu_indices(3)


def length(points: Float64, pair: tuple[int, int]) -> Float64:
    return np.asarray(np.sqrt(np.sum((points[..., pair[0], :] - points[..., pair[1], :]) ** 2, -1)))


def angle(points: Float64, triple: tuple[int, int, int]) -> Float64:
    """Return it by the law of cosines."""
    a, b, c = triple
    near, far, across = (length(points, pair) for pair in ((a, b), (b, c), (a, c)))
    return np.asarray(np.degrees(np.arccos((near**2 + far**2 - across**2) / (2 * near * far))))


def ratio(points: Float64, pairs: tuple[tuple[int, int], tuple[int, int]]) -> Float64:
    return length(points, pairs[0]) / length(points, pairs[1])


def drawn(size: float) -> tuple[Lift, Float64]:
    """Return a lift whose points are off by about so much, and its Sigma (N, 3 P, 3 P)."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(FRAMES, POINTS, 3)).astype(np.float32)
    modes = size * rng.normal(size=(FRAMES, POINTS, 3, MODES)) / np.sqrt(MODES)
    own = 0.5 * size * rng.normal(size=(FRAMES, POINTS, 3, 3))
    blocks = own @ own.mT + modes @ modes.mT
    rows = modes.reshape(FRAMES, 3 * POINTS, MODES)
    whole = rows @ rows.mT
    for p in range(POINTS):
        whole[:, 3 * p : 3 * p + 3, 3 * p : 3 * p + 3] = blocks[:, p]
    return lift(points, blocks[..., *UPPER], modes), whole


def lift(points: NDArray[np.float32], covariances: Float64 | None, modes: Float64 | None) -> Lift:
    others = dict.fromkeys(
        (
            *("rotations", "scales", "translations", "focals", "principal_points", "distortions"),
            *("reprojection_errors", "keypoints_used", "camera_models"),
        ),
        np.zeros((len(points), 0), np.float32),
    )
    known = {"points3d_covariance": covariances, "points3d_modes": modes}
    asked = {name: array.astype(np.float32) for name, array in known.items() if array is not None}
    arrays: dict[str, Any] = {**others, **asked}
    return Lift(points, **arrays)


MEASURES = [
    (lambda of: of.lengths(PAIRS), length, PAIRS),
    (lambda of: of.angles(TRIPLES), angle, TRIPLES),
    (lambda of: of.ratios(RATIOS), ratio, RATIOS),
]
each_measure = pytest.mark.parametrize(
    ("measured", "expected", "chosen"), MEASURES, ids=["lengths", "angles", "ratios"]
)


@each_measure
def test_deviations_are_those_of_the_dense_covariance_and_its_derivatives(
    measured: Callable[[Lift], Measured], expected: Callable[..., Float64], chosen: list[object]
) -> None:
    found, whole = drawn(0.03)
    values, sds = measured(found)
    assert values.shape == sds.shape == (FRAMES, len(chosen))
    points, step = found.points3d.astype(np.float64), 1e-5
    for number, one in enumerate(chosen):
        np.testing.assert_allclose(values[:, number], expected(points, one), rtol=1e-6)
        slopes = np.empty((FRAMES, 3 * POINTS))
        for column in range(3 * POINTS):
            moved = np.zeros(3 * POINTS)
            moved[column] = step
            ends = [expected(points + way * moved.reshape(-1, 3), one) for way in (1, -1)]
            slopes[:, column] = (ends[0] - ends[1]) / (2 * step)
        variances = np.einsum("ni,nij,nj->n", slopes, whole, slopes)
        np.testing.assert_allclose(sds[:, number], np.sqrt(variances), rtol=1e-4, atol=1e-7)


@each_measure
def test_deviations_are_those_of_draws(
    measured: Callable[[Lift], Measured], expected: Callable[..., Float64], chosen: list[object]
) -> None:
    found, whole = drawn(0.01)
    _, sds = measured(found)
    roots = np.linalg.cholesky(whole)
    noise = np.random.default_rng(1).normal(size=(20_000, FRAMES, 3 * POINTS, 1))
    points = found.points3d + (roots @ noise)[..., 0].reshape(-1, FRAMES, POINTS, 3)
    for number, one in enumerate(chosen):
        spread = expected(points, one).std(0)
        np.testing.assert_allclose(sds[:, number], spread, rtol=0.05, atol=1e-6)


def test_what_all_points_share_leaves_ratios_and_angles_as_they_are() -> None:
    """Of a structure whose scale alone is unsure, by a tenth."""
    points = np.random.default_rng(2).normal(size=(FRAMES, POINTS, 3)).astype(np.float32)
    modes = np.zeros((FRAMES, POINTS, 3, MODES))
    modes[..., 3] = 0.1 * points
    found = lift(points, (modes @ modes.mT)[..., *UPPER], modes)
    values, sds = found.lengths(PAIRS)
    np.testing.assert_allclose(sds, 0.1 * values, rtol=1e-5)
    assert (found.angles(TRIPLES).sds < 1e-2).all()  # degrees; float32 knows no more
    assert (found.ratios(RATIOS).sds < 1e-3 * found.ratios(RATIOS).values).all()


def test_what_is_not_known_is_nan() -> None:
    found, _ = drawn(0.03)
    found.points3d[1, 0] = np.nan
    assert found.points3d_covariance is not None
    assert found.points3d_modes is not None
    found.points3d_covariance[2] = found.points3d_modes[2] = np.nan
    values, sds = found.lengths([(0, 1), (2, 3)])
    np.testing.assert_array_equal(
        np.isnan(values), [[False, False], [True, False], *[[False] * 2] * 2]
    )
    np.testing.assert_array_equal(
        np.isnan(sds), [[False, False], [True, False], [True] * 2, [False] * 2]
    )
    plain = lift(found.points3d, None, None)
    np.testing.assert_array_equal(plain.angles(TRIPLES).values, found.angles(TRIPLES).values)
    assert np.isnan(plain.angles(TRIPLES).sds).all()
    assert found.lengths(np.empty((0, 2), int)).values.shape == (FRAMES, 0)


@pytest.mark.parametrize(
    ("measured", "chosen", "why"),
    [
        (Lift.lengths, [(0, 6)], "pairs: expected keypoints 0 to 5, got 6"),
        (Lift.lengths, [(0, -1)], "got -1"),
        (Lift.lengths, [(2, 2)], r"expected keypoints that differ, got \[2, 2\]"),
        (Lift.lengths, (0, 1), "expected a list of 2 keypoints each"),
        (Lift.lengths, [(0.0, 1.0)], "by their numbers from 0"),
        (Lift.lengths, [("hip", "knee")], "by their numbers from 0"),
        (Lift.angles, [(0, 1)], "triples: expected a list of 3 keypoints each"),
        (Lift.ratios, [(0, 1), (2, 3)], "expected a list of pairs of 2 keypoints each"),
    ],
)
def test_keypoints_that_there_are_not_are_refused(
    measured: Callable[[Lift, Any], Measured], chosen: Any, why: str
) -> None:
    found, _ = drawn(0.03)
    with pytest.raises(ValueError, match=why):
        measured(found, chosen)
