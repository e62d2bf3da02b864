"""The interface to all camera models: pixels of points in a camera's frame, with derivatives."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import compiled, inner
from models.numerics.threads import empty_aligned
from models.optics.lenses import kannala_brandt, pinhole
from models.optics.lenses.bending import Bending, LensModel
from models.settings.calibration import NUMBERS_OF_COEFFICIENTS, LensName

Float64 = NDArray[np.float64]

LENSES: tuple[LensModel, ...] = (pinhole, kannala_brandt)  # a model's index is its place here
PINHOLE, KANNALA_BRANDT = LENSES.index(pinhole), LENSES.index(kannala_brandt)
COEFFICIENTS = max(max(NUMBERS_OF_COEFFICIENTS[lens.NAME]) for lens in LENSES)
NEAREST_DEPTH = 1e-6  # depths nearer to 0 than this, in the points' unit, count as this


class Lenses(NamedTuple):
    """Lenses of K views."""

    focals: Float64  # (K, 2) pixels, along x and y
    centres: Float64  # (K, 2) principal points, pixels
    distortion: Float64  # (K, 8) unitless, in the model's order, 0 where unused
    models: NDArray[np.int8]  # (K,) places of the camera models in `LENSES`

    def of(self, views: NDArray[np.int64] | slice) -> "Lenses":
        """Return the lenses of some of the views."""
        return Lenses(
            self.focals[views], self.centres[views], self.distortion[views], self.models[views]
        )


def index_of(name: LensName) -> int:
    """Return the place of a camera model in `LENSES`."""
    return [lens.NAME for lens in LENSES].index(name)


def project(points: Float64, lenses: Lenses) -> Float64:
    """Pixels (..., K, P, 2) of points (..., K, P, 3) in the cameras' frames."""
    views, count = points.shape[-3:-1]
    pixels = empty_aligned(*points.shape[:-1], 2)
    _project(
        np.ascontiguousarray(points).reshape(-1, views, count, 3),
        lenses,
        pixels.reshape(-1, views, count, 2),
    )
    return pixels


@compiled
def _project(points: Float64, lenses: Lenses, pixels: Float64) -> None:
    frames, views, count, _ = points.shape
    for n in range(frames):
        for k in range(views):
            for p in range(count):
                project_into(points[n, k, p], lenses, k, pixels[n, k, p])


@inner
def project_into(point: Float64, lenses: Lenses, view: int, pixel: Float64) -> None:
    """Write the pixel (2,) of a point (3,) in the frame of the camera `view`."""
    depth = point[2] if abs(point[2]) >= NEAREST_DEPTH else NEAREST_DEPTH
    a, b = point[0] / depth, point[1] / depth
    x, y = _bend(lenses.models[view], a, b, lenses.distortion[view])
    pixel[0] = lenses.focals[view, 0] * x + lenses.centres[view, 0]
    pixel[1] = lenses.focals[view, 1] * y + lenses.centres[view, 1]


@compiled
def differentiate_into(
    point: Float64,
    lenses: Lenses,
    view: int,
    pixel: Float64,
    by_point: Float64,
    by_lens: Float64,
) -> None:
    """Write the pixel (2,) and its derivatives.

    Derivatives are by the point, (2, 3), and by the log focal length, the principal point (x, y)
    and the first two radial coefficients, (2, 5).
    """
    depth = point[2] if abs(point[2]) >= NEAREST_DEPTH else NEAREST_DEPTH
    a, b = point[0] / depth, point[1] / depth
    bent = _differentiate(lenses.models[view], a, b, lenses.distortion[view])
    fx, fy = lenses.focals[view, 0], lenses.focals[view, 1]
    pixel[0] = fx * bent.x + lenses.centres[view, 0]
    pixel[1] = fy * bent.y + lenses.centres[view, 1]
    # The direction by the point: [1 0 -a; 0 1 -b] / z.
    by_point[0, 0], by_point[0, 1] = fx * bent.x_by_a / depth, fx * bent.x_by_b / depth
    by_point[0, 2] = -fx * (bent.x_by_a * a + bent.x_by_b * b) / depth
    by_point[1, 0], by_point[1, 1] = fy * bent.y_by_a / depth, fy * bent.y_by_b / depth
    by_point[1, 2] = -fy * (bent.y_by_a * a + bent.y_by_b * b) / depth
    by_lens[0, 0], by_lens[1, 0] = fx * bent.x, fy * bent.y
    by_lens[0, 1], by_lens[1, 1] = 1.0, 0.0
    by_lens[0, 2], by_lens[1, 2] = 0.0, 1.0
    by_lens[0, 3], by_lens[1, 3] = fx * bent.x_by_k1, fy * bent.y_by_k1
    by_lens[0, 4], by_lens[1, 4] = fx * bent.x_by_k2, fy * bent.y_by_k2


@inner
def _bend(model: int, a: float, b: float, k: Float64) -> tuple[float, float]:
    if model == KANNALA_BRANDT:
        return kannala_brandt.bend(a, b, k)
    return pinhole.bend(a, b, k)


@inner
def _differentiate(model: int, a: float, b: float, k: Float64) -> Bending:
    if model == KANNALA_BRANDT:
        return kannala_brandt.differentiate(a, b, k)
    return pinhole.differentiate(a, b, k)
