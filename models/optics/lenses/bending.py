"""The interface of camera models: how a lens bends a direction, with derivatives.

A direction is (a, b) = (x / z, y / z) of a point (x, y, z) in the camera's frame; a lens bends it
to (x', y'), and the pixel is (fx x' + cx, fy y' + cy).
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from models.settings.calibration import LensName, LiftedLensName

Float64 = NDArray[np.float64]


class Bending(NamedTuple):
    """A bent direction and its derivatives; unitless."""

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
    """The attributes of a camera model's file besides its compiled `bend` and `differentiate`."""

    NAME: LensName  # in a calibration, and in files
    LIFTED_AS: LiftedLensName  # in what lifts return of their cameras

    def start_from_pinhole(self, distortion: Float64) -> Float64 | None:
        """Return coefficients (n, 8) with which to try this model, or None if it is unlikely.

        `distortion` (n, 8) are the pinhole coefficients estimated for lenses that were not given.
        """
