"""Lenses against OpenCV's documentation, written out once more for one point at a time."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.optics.lenses import Optics, derive, image
from models.optics.lenses import lenses as lenses_of

Float64 = NDArray[np.float64]
KINDS = ("plain", "radial", "tangential", "rational", "fisheye")
COEFFICIENTS = {
    "plain": (),
    "radial": (-0.21, 0.07),
    "tangential": (-0.15, 0.04, 0.011, -0.006, 0.02),
    "rational": (0.4, -0.1, 0.003, 0.002, 0.01, 0.55, -0.05, 0.004),
    "fisheye": (-0.03, 0.012, -0.004, 0.002),
}
STEP = 1e-6


def opencv(point: Float64, lens: "Lens") -> Float64:
    """Project as the documentation of calib3d and of its fisheye model says."""
    k = dict(enumerate(lens.distortion, start=1))
    x, y = point[0] / point[2], point[1] / point[2]
    r = math.hypot(x, y)
    if lens.fisheye:
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

    def __init__(self, kind: str, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.fisheye = kind == "fisheye"
        self.distortion = COEFFICIENTS[kind]
        self.focal = rng.uniform(300, 1500, 2)
        self.centre = rng.uniform(200, 900, 2)


def optics(lenses: list[Lens]) -> Optics:
    distortion = torch.zeros(len(lenses), 8, dtype=torch.float64)
    for k, lens in enumerate(lenses):
        distortion[k, : len(lens.distortion)] = torch.tensor(lens.distortion, dtype=torch.float64)
    return Optics(
        torch.from_numpy(np.stack([lens.focal for lens in lenses])),
        torch.from_numpy(np.stack([lens.centre for lens in lenses])),
        distortion,
        torch.tensor([lens.fisheye for lens in lenses]),
    )


def points(seed: int, frames: int, views: int, count: int, reach: float = 0.9) -> Tensor:
    """Points up to `reach` beside the axis at depth 1, some of them on the axis itself."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 9, (frames, views, count, 1))
    flat = rng.uniform(-reach, reach, (frames, views, count, 2))
    flat[:, :, 0] = 0
    flat[:, :, 1] = 1e-6
    return torch.from_numpy(np.concatenate((flat * depth, depth), -1))


@pytest.fixture
def lenses() -> list[Lens]:
    """One of each kind: they must not disturb each other."""
    return [Lens(kind, seed) for seed, kind in enumerate(KINDS)]


def test_every_lens_projects_as_opencvs(lenses: list[Lens]) -> None:
    world = points(0, 3, len(lenses), 12)
    found = image(world, optics(lenses)).numpy()
    for n, k, p in np.ndindex(world.shape[:3]):
        expected = opencv(world[n, k, p].numpy(), lenses[k])
        np.testing.assert_allclose(found[n, k, p], expected, rtol=0, atol=1e-7, err_msg=KINDS[k])


def test_a_fisheye_sees_far_beside_its_axis() -> None:
    lens = Lens("fisheye", 5)
    wide = torch.tensor([[[[5.0, -3.0, 1.0], [-40.0, 20.0, 1.0]]]], dtype=torch.float64)
    found = image(wide, optics([lens]))[0, 0].numpy()
    expected = [opencv(point.numpy(), lens) for point in wide[0, 0]]
    np.testing.assert_allclose(found, np.stack(expected), rtol=0, atol=1e-7)
    # Nearly at a right angle to the axis, where a pinhole would see it tens of thousands away.
    assert np.abs(found - lens.centre).max() < 2 * lens.focal.max()


def differences(project: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Central differences of pixels (..., 2) by numbers (..., C), each point by its own."""
    columns = []
    for c in range(at.shape[-1]):
        step = torch.zeros(at.shape[-1], dtype=at.dtype)
        step[c] = STEP
        columns.append((project(at + step) - project(at - step)) / (2 * STEP))
    return torch.stack(columns, -1)


def derivatives(world: Tensor, lens: Optics) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, K, P, 2), their derivatives by the points (..., 2, 3) and the lens (..., 2, 4)."""
    pixels, by_points, by_optics = (
        np.empty((*world.shape[:-1], *shape)) for shape in ((2,), (2, 3), (2, 4))
    )
    glass = lenses_of(lens)
    for place in np.ndindex(world.shape[:-1]):
        point = world[place].numpy()
        derive(point, glass, place[1], pixels[place], by_points[place], by_optics[place])
    return torch.from_numpy(pixels), torch.from_numpy(by_points), torch.from_numpy(by_optics)


def test_derivatives_by_the_points_agree_with_differences(lenses: list[Lens]) -> None:
    world, lens = points(1, 2, len(lenses), 9), optics(lenses)
    pixels, by_points, _ = derivatives(world, lens)
    torch.testing.assert_close(pixels, image(world, lens), rtol=1e-13, atol=1e-9)
    expected = differences(lambda x: image(x, lens), world)
    torch.testing.assert_close(by_points, expected, rtol=1e-6, atol=1e-3)


def test_derivatives_by_the_lens_agree_with_differences(lenses: list[Lens]) -> None:
    world, lens = points(2, 2, len(lenses), 9), optics(lenses)
    _, _, by_optics = derivatives(world, lens)

    def changed(x: Tensor) -> Tensor:
        distortion = lens.distortion.clone()
        distortion[:, 0] += x[3]
        focals = lens.focals * x[0].exp()
        return image(world, Optics(focals, lens.centres + x[1:3], distortion, lens.fisheye))

    expected = differences(changed, torch.zeros(4, dtype=torch.float64))
    torch.testing.assert_close(by_optics, expected, rtol=1e-6, atol=1e-3)


def test_one_lens_alone_and_among_others_projects_alike(lenses: list[Lens]) -> None:
    world, all_of_them = points(3, 2, len(lenses), 9), optics(lenses)
    together = derivatives(world, all_of_them)
    for k in range(len(lenses)):
        lens = Optics(*(part[k : k + 1] for part in all_of_them))
        alone = derivatives(world[:, k : k + 1], lens)
        for mine, ours in zip(alone, together, strict=True):
            torch.testing.assert_close(mine, ours[:, k : k + 1], rtol=1e-12, atol=1e-9)
