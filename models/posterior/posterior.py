"""The posterior of a fit: what its lifts need to answer how far each point may be off."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import FOCAL, VIEW
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import in_slices
from models.posterior.answers import Lifted, Noise
from models.posterior.deviations import Deviations, write_deviations
from models.posterior.frames import FRAMES_AT_A_TIME, LearntShapes
from models.posterior.quality import FIGURES
from models.settings.uncertainty import MODES, SYMMETRIC

Float64 = NDArray[np.float64]

POSTERIOR_KIND = "corrected"  # in files
UNKNOWN_LENS = 0.15  # deviation of the log focal length of a camera that the fit does not know
MOST_COMPONENTS, MOST_FACTORS = 64, 64  # that a file may hold


class Posterior(NamedTuple):
    """Shapes, noise and cameras of a fit of K views and P keypoints."""

    mean: Float64  # (P, 3) of `LearntShapes`
    basis: Float64  # (P, 3, Q)
    variances: Float64  # (P,)
    noise: Float64  # (K, P) pixels, of a coordinate of confidence 1
    factor: Float64  # (K, 11, T) the covariance of the cameras' numbers is L L^T
    # In keypoints of the fit's views, as in `Noise`:
    left: Float64  # (2,)
    corrections: Float64  # (2, K + 1)
    # (3,) figures of frames, as in `models.posterior.quality`; 0 if not known
    usual: Float64

    def deviations(self, lifted: Lifted, views: Sequence[int] | None, *, modes: bool) -> Deviations:
        """Return how far the points of a lift may be off.

        NaN for frames without a perspective camera. In the unit of the answers. A structure's place
        and direction are no part of what points share, nor is its size where no static rig gives
        it.

        Parameters
        ----------
        views
            Which views of the fit they are; None: cameras that it does not know.
        modes
            Whether covariances and modes are wanted.
        """
        frames, count, _ = lifted.answers.points3d.shape
        out = unknown_deviations(frames, count, modes=modes)
        factor = self._factor_of(views, lifted.seen.weights.shape[1])
        in_slices(
            frames,
            FRAMES_AT_A_TIME,
            lambda part: write_deviations(lifted, factor, part.start, part.stop, out),
        )
        return out

    @property
    def shapes(self) -> LearntShapes:
        """The shapes of the fit."""
        return LearntShapes(self.mean, self.basis, self.variances)

    def noise_of(self, views: Sequence[int] | None, count: int) -> Noise:
        """Return the noise of some views of the fit; None: of `count` cameras it does not know."""
        if views is None:  # nothing was removed, nor is anything known of what lifts make of it
            usual = np.sqrt(np.square(self.noise).mean(0))
            return Noise(np.tile(usual, (count, 1)), np.ones(2), np.ones((2, count + 1)))
        return Noise(self.noise[list(views)], self.left, self.corrections)

    def _factor_of(self, views: Sequence[int] | None, count: int) -> Float64:
        if views is None:
            factor = np.zeros((count, VIEW, count))
            factor[:, FOCAL] = UNKNOWN_LENS * np.eye(count)
            return factor
        return np.ascontiguousarray(self.factor[list(views)])

    def to_arrays(self) -> Arrays:
        """Return the posterior as tensors, for a file."""
        return as_tensors(self._asdict())

    @classmethod
    def shapes_in_files(cls, keypoints: int, kind: str) -> Shapes:
        """Shapes of what `to_arrays` returns; None stands for any length.

        Those of the `kind` "yes", of older versions, had no corrections.
        """
        shapes: Shapes = {
            "mean": (keypoints, 3),
            "basis": (keypoints, 3, None),
            "variances": (keypoints,),
            "noise": (None, keypoints),
            "factor": (None, VIEW, None),
        }
        if kind != POSTERIOR_KIND:
            return shapes | {"left": (1,)}
        return shapes | {"left": (2,), "corrections": (2, None), "usual": (FIGURES,)}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Posterior":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        numbers = {
            name: np.ascontiguousarray(array.numpy(), np.float64) for name, array in arrays.items()
        }
        if "corrections" not in numbers:
            numbers["left"] = np.repeat(numbers["left"], 2)
            numbers["corrections"] = np.ones((2, len(numbers["noise"]) + 1))
            numbers["usual"] = np.zeros(FIGURES)
        found = cls(**numbers)
        positive = (found.variances, found.noise, found.left, found.corrections)
        agree = (
            len(found.noise) == len(found.factor)
            and found.corrections.shape[1] == len(found.noise) + 1
            and found.basis.shape[2] <= MOST_COMPONENTS
            and found.factor.shape[2] <= MOST_FACTORS
            and all((array > 0).all() for array in positive)
            and bool((found.usual >= 0).all())
        )
        if not agree:
            raise WeightsError("the file contradicts itself about its posterior")
        return found


def unknown_deviations(frames: int, keypoints: int, *, modes: bool) -> Deviations:
    """Return NaN for so many frames of so many keypoints."""
    columns = (SYMMETRIC, MODES) if modes else (0, 0)
    return Deviations(
        np.full((frames, keypoints), np.nan, np.float32),
        np.full((frames, keypoints, columns[0]), np.nan, np.float32),
        np.full((frames, keypoints, 3, columns[1]), np.nan, np.float32),
        np.full((frames, FIGURES), np.nan),
    )
