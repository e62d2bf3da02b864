"""The posterior of a fit: what its lifts need to answer how far each point may be off."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import VIEW, Rig
from models.capture.observations import Observations
from models.network.answers import MODES, Answers
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import in_slices
from models.posterior.deviations import Uncertainty, write_deviations
from models.posterior.frames import FRAMES_AT_A_TIME, LearntShapes

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MOST_COMPONENTS, MOST_FACTORS = 64, 64  # that a file may hold
SYMMETRIC = 6  # numbers of a symmetric matrix (3, 3)
NUMBERS = ("mean", "basis", "variances", "noise", "factor")  # that are arrays


class Posterior(NamedTuple):
    """Shapes, noise and cameras of a fit of K views and P keypoints."""

    mean: Float64  # (P, 3) of `LearntShapes`
    basis: Float64  # (P, 3, Q)
    variances: Float64  # (P,)
    noise: Float64  # (K, P) pixels, of a coordinate of confidence 1
    factor: Float64  # (K, 11, T) the covariance of the cameras' numbers is L L^T
    left: float  # share of the noise that its removal leaves in keypoints of the fit's views

    def uncertainty(
        self,
        answers: Answers,
        rig: Rig,
        views: Sequence[int] | None,
        seen: Observations,
        detected: Float32,
        *,
        modes: bool,
    ) -> Uncertainty:
        """Return how far the points of answers may be off.

        NaN for frames without a perspective camera. In the unit of the answers. A structure's place
        and direction are no part of what points share, nor is its size where no static rig gives
        it.

        Parameters
        ----------
        answers
            Refined ones with all their points.
        rig
            Of the K views of the answers.
        views
            Which views of the fit they are; None: cameras that it does not know.
        seen, detected
            The keypoints; those before noise was removed as in `ObservedFrames`.
        modes
            Whether covariances and modes are wanted.
        """
        noise, factor = self._of(views, seen.weights.shape[1])
        frames, count, _ = answers.points3d.shape
        out = unknown_uncertainty(frames, count, modes=modes)
        shapes = LearntShapes(self.mean, self.basis, self.variances)
        in_slices(
            frames,
            FRAMES_AT_A_TIME,
            lambda part: write_deviations(
                answers, rig, seen, detected, shapes, noise, factor, part.start, part.stop, out
            ),
        )
        return out

    def _of(self, views: Sequence[int] | None, count: int) -> tuple[Float64, Float64]:
        """Return noise (K, P) and factor (K, 11, T) of some views."""
        if views is None:
            noise = np.sqrt(np.square(self.noise).mean(0))
            return np.tile(noise, (count, 1)), np.zeros((count, *self.factor.shape[1:]))
        chosen = list(views)
        return self.left * self.noise[chosen], np.ascontiguousarray(self.factor[chosen])

    def to_arrays(self) -> Arrays:
        """Return the posterior as tensors, for a file."""
        return as_tensors(self._asdict())

    @classmethod
    def shapes(cls, keypoints: int) -> Shapes:
        """Shapes of what `to_arrays` returns; None stands for any length."""
        return {
            "mean": (keypoints, 3),
            "basis": (keypoints, 3, None),
            "variances": (keypoints,),
            "noise": (None, keypoints),
            "factor": (None, VIEW, None),
            "left": (1,),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Posterior":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        numbers = [np.ascontiguousarray(arrays[name].numpy(), np.float64) for name in NUMBERS]
        mean, basis, variances, noise, factor = numbers
        found = cls(mean, basis, variances, noise, factor, arrays["left"].item())
        agree = (
            len(found.noise) == len(found.factor)
            and found.basis.shape[2] <= MOST_COMPONENTS
            and found.factor.shape[2] <= MOST_FACTORS
            and 0 < found.left <= 1
            and bool((found.variances > 0).all() and (found.noise > 0).all())
        )
        if not agree:
            raise WeightsError("the file contradicts itself about its posterior")
        return found


def unknown_uncertainty(frames: int, keypoints: int, *, modes: bool) -> Uncertainty:
    """Return NaN for so many frames of so many keypoints."""
    columns = (SYMMETRIC, MODES) if modes else (0, 0)
    return Uncertainty(
        np.full((frames, keypoints), np.nan, np.float32),
        np.full((frames, keypoints, columns[0]), np.nan, np.float32),
        np.full((frames, keypoints, 3, columns[1]), np.nan, np.float32),
    )
