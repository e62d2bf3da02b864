"""Lenses against OpenCV's documentation, written out once more for one point at a time."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from models.optics.lenses.projection import (
    COEFFICIENTS as MOST_COEFFICIENTS,
)
from models.optics.lenses.projection import (
    LENSES,
    Lenses,
    differentiate_into,
    index_of,
    project,
)
from models.settings.calibration import NUMBERS_OF_COEFFICIENTS, LensName

Float64 = NDArray[np.float64]
KINDS: tuple[tuple[LensName, tuple[float, ...]], ...] = (
    ("pinhole", ()),
    ("pinhole", (-0.21, 0.07)),
    ("pinhole", (-0.15, 0.04, 0.011, -0.006, 0.02)),
    ("pinhole", (0.4, -0.1, 0.003, 0.002, 0.01, 0.55, -0.05, 0.004)),
    ("fisheye", ()),
    ("fisheye", (-0.03, 0.012, -0.004, 0.002)),
)
STEP = 1e-6


def opencv(point: Float64, lens: "Lens") -> Float64:
    """Project by the formulas in the documentation of calib3d and of its fisheye model."""
    k = dict(enumerate(lens.distortion, start=1))
    x, y = point[0] / point[2], point[1] / point[2]
    r = math.hypot(x, y)
    if lens.model == "fisheye":
        theta = math.atan(r)
        theta_d = theta * (1 + sum(k.get(i, 0.0) * theta ** (2 * i) for i in (1, 2, 3, 4)))
        share = theta_d / r if r > 0 else 1.0
        x, y = share * x, share * y
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (k.get(i, 0.0) for i in range(1, 9))
        top = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        radial = top / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    return np.array([lens.focal[0] * x + lens.centre[0], lens.focal[1] * y + lens.centre[1]])


class Lens:
    """One lens as its user would write it down."""

    def __init__(self, model: LensName, distortion: tuple[float, ...], seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.model = model
        self.distortion = distortion
        self.focal = rng.uniform(300, 1500, 2)
        self.centre = rng.uniform(200, 900, 2)


def laid_out(lenses: list[Lens]) -> Lenses:
    distortion = np.zeros((len(lenses), MOST_COEFFICIENTS))
    for k, lens in enumerate(lenses):
        distortion[k, : len(lens.distortion)] = lens.distortion
    return Lenses(
        np.stack([lens.focal for lens in lenses]),
        np.stack([lens.centre for lens in lenses]),
        distortion,
        np.array([index_of(lens.model) for lens in lenses], np.int8),
    )


def points(seed: int, frames: int, views: int, count: int, reach: float = 0.9) -> Float64:
    """Points up to `reach` beside the axis at depth 1, some of them on the axis itself."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 9, (frames, views, count, 1))
    flat = rng.uniform(-reach, reach, (frames, views, count, 2))
    flat[:, :, 0] = 0
    flat[:, :, 1] = 1e-6
    return np.concatenate((flat * depth, depth), -1)


@pytest.fixture
def lenses() -> list[Lens]:
    """One of each kind: they must not disturb each other."""
    return [Lens(*kind, seed) for seed, kind in enumerate(KINDS)]


def test_every_lens_projects_as_opencvs(lenses: list[Lens]) -> None:
    world = points(0, 3, len(lenses), 12)
    pixels = project(world, laid_out(lenses))
    for n, k, p in np.ndindex(world.shape[:3]):
        expected = opencv(world[n, k, p], lenses[k])
        np.testing.assert_allclose(pixels[n, k, p], expected, rtol=0, atol=1e-7, err_msg=KINDS[k])


def test_every_camera_model_is_tested_and_can_be_given() -> None:
    names = [lens.NAME for lens in LENSES]
    assert set(names) == {name for name, _ in KINDS} == NUMBERS_OF_COEFFICIENTS.keys()
    assert len(set(names)) == len({lens.LIFTED_AS for lens in LENSES}) == len(names)
    for name, distortion in KINDS:
        assert len(distortion) in NUMBERS_OF_COEFFICIENTS[name]


def test_a_fisheye_sees_far_beside_its_axis() -> None:
    lens = Lens("fisheye", (-0.03, 0.012, -0.004, 0.002), 5)
    wide = np.array([[[[5.0, -3.0, 1.0], [-40.0, 20.0, 1.0]]]])
    pixels = project(wide, laid_out([lens]))[0, 0]
    expected = [opencv(point, lens) for point in wide[0, 0]]
    np.testing.assert_allclose(pixels, np.stack(expected), rtol=0, atol=1e-7)
    # Nearly at a right angle to the axis, where a pinhole would see it tens of thousands away.
    assert np.abs(pixels - lens.centre).max() < 2 * lens.focal.max()


def differences(function: Callable[[Float64], Float64], at: Float64) -> Float64:
    """Central differences of pixels (..., 2) by numbers (..., C), each point by its own."""
    steps = STEP * np.eye(at.shape[-1])
    columns = [(function(at + step) - function(at - step)) / (2 * STEP) for step in steps]
    return np.stack(columns, -1)


def derivatives(world: Float64, lenses: Lenses) -> tuple[Float64, Float64, Float64]:
    """Pixels (N, K, P, 2), their derivatives by the points (..., 2, 3) and the lens (..., 2, 5)."""
    pixels, by_points, by_lens = (
        np.empty((*world.shape[:-1], *shape)) for shape in ((2,), (2, 3), (2, 5))
    )
    for place in np.ndindex(world.shape[:-1]):
        view = place[1]
        differentiate_into(
            world[place], lenses, view, pixels[place], by_points[place], by_lens[place]
        )
    return pixels, by_points, by_lens


def test_derivatives_by_the_points_agree_with_differences(lenses: list[Lens]) -> None:
    world, glass = points(1, 2, len(lenses), 9), laid_out(lenses)
    pixels, by_points, _ = derivatives(world, glass)
    np.testing.assert_allclose(pixels, project(world, glass), rtol=1e-13, atol=1e-9)
    expected = differences(lambda x: project(x, glass), world)
    np.testing.assert_allclose(by_points, expected, rtol=1e-6, atol=1e-3)


def test_derivatives_by_the_lens_agree_with_differences(lenses: list[Lens]) -> None:
    world, glass = points(2, 2, len(lenses), 9), laid_out(lenses)
    _, _, by_lens = derivatives(world, glass)

    def changed(x: Float64) -> Float64:
        distortion = glass.distortion.copy()
        distortion[:, :2] += x[3:]
        other = glass._replace(
            focals=glass.focals * np.exp(x[0]),
            centres=glass.centres + x[1:3],
            distortion=distortion,
        )
        return project(world, other)

    expected = differences(changed, np.zeros(5))
    np.testing.assert_allclose(by_lens, expected, rtol=1e-6, atol=1e-3)


def test_one_lens_alone_and_among_others_projects_alike(lenses: list[Lens]) -> None:
    world, glass = points(3, 2, len(lenses), 9), laid_out(lenses)
    together = derivatives(world, glass)
    for k in range(len(lenses)):
        part = slice(k, k + 1)
        alone = derivatives(world[:, part], glass.of(part))
        for mine, ours in zip(alone, together, strict=True):
            np.testing.assert_allclose(mine, ours[:, part], rtol=1e-12, atol=1e-9)
