"""What every camera model tells: where a lens sends a direction, and how that changes.

A direction is (a, b) = (x / z, y / z) of a point (x, y, z) in the camera's frame; a lens bends it
to (x', y'), and the pixel is (fx x' + cx, fy y' + cy).
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from models.settings.calibration import LensName, LiftedLensName

Float64 = NDArray[np.float64]


class Bending(NamedTuple):
    """A direction behind the lens, and its derivatives; unitless."""

    x: float
    y: float
    x_by_a: float
    x_by_b: float
    y_by_a: float
    y_by_b: float
    x_by_k1: float  # k1 and k2 are the first two coefficients, which self-calibration estimates
    y_by_k1: float
    x_by_k2: float
    y_by_k2: float


class LensModel(Protocol):
    """What the file of a camera model offers beside its compiled `bend` and `differentiate`."""

    NAME: LensName  # in a calibration, and in files
    LIFTED_AS: LiftedLensName  # in what lifts say of their cameras

    def start_from_pinhole(self, distortion: Float64) -> Float64 | None:
        """Say whether a pinhole solution looks as if its lenses were of this model.

        `distortion` (n, 8) are the pinhole's coefficients of the lenses that nobody told. Returns
        the coefficients (n, 8) to try this model with, or None if it is not worth a try.
        """
