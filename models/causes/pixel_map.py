"""Maps from a view's pixels as they came to pixels as its camera saw them, and back."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Float64 = NDArray[np.float64]

LEAST_AREA, MOST_AREA = 1e-6, 1e6  # of the mended image of one pixel


class PixelMap(NamedTuple):
    """x' = a x + b y + c, y' = d x + e y + f, after an uneven stretch of x was undone.

    An uneven stretch took u, the distance from the image's middle in half widths, to
    u (1 - bend + bend u^2).
    """

    a: float = 1.0
    b: float = 0.0
    c: float = 0.0
    d: float = 0.0
    e: float = 1.0
    f: float = 0.0
    bend: float = 0.0  # 0 to 0.9
    middle: float = 0.0  # pixels
    half: float = 1.0  # pixels

    def mended(self, pixels: Array) -> Float64:
        """Return pixels (..., 2) as the camera saw them, from pixels as they came."""
        even = np.array(pixels, np.float64)
        if self.bend:
            even[..., 0] = self.middle + self.half * evened(
                (even[..., 0] - self.middle) / self.half, self.bend
            )
        return even @ self._matrix.T + self._shift

    def unmended(self, pixels: Array) -> Float64:
        """Return pixels (..., 2) as they came, from pixels as the camera saw them."""
        even = (np.asarray(pixels, np.float64) - self._shift) @ np.linalg.inv(self._matrix).T
        if self.bend:
            u = (even[..., 0] - self.middle) / self.half
            even[..., 0] = self.middle + self.half * u * (1 - self.bend + self.bend * u * u)
        return np.asarray(even)

    def after(self, before: "PixelMap") -> "PixelMap":
        """Return the map that first takes the map `before`; only that one may bend."""
        matrix = self._matrix @ before._matrix
        (a, b), (d, e) = matrix.tolist()
        c, f = (self._matrix @ before._shift + self._shift).tolist()
        return PixelMap(a, b, c, d, e, f, before.bend, before.middle, before.half)

    @property
    def valid(self) -> bool:
        """Whether it can be undone, and all its numbers are finite."""
        return (
            bool(np.isfinite(self).all())
            and LEAST_AREA < abs(self.a * self.e - self.b * self.d) < MOST_AREA
            and 0 <= self.bend <= 0.9
            and self.half > 0
        )

    @property
    def _matrix(self) -> Float64:
        return np.array([[self.a, self.b], [self.d, self.e]])

    @property
    def _shift(self) -> Float64:
        return np.array([self.c, self.f])


def evened(stretched: Float64, bend: float) -> Float64:
    """Solve stretched = u (1 - bend + bend u^2) for u: the one root of a rising cubic (Cardano)."""
    p, q = (1 - bend) / (3 * bend), stretched / (2 * bend)
    u: Float64 = 2 * np.sqrt(p) * np.sinh(np.arcsinh(q / p**1.5) / 3)
    return u
