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
from models.posterior.deviations import write_deviations
from models.posterior.frames import (
    FRAMES_AT_A_TIME,
    Covariances,
    LearntShapes,
    make_covariances,
)

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
    ) -> tuple[Float32, Float32, Float32]:
        """Return `points3d_sd`, `points3d_covariance` and `points3d_modes` of answers.

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
            Whether the last two are wanted; else they have no columns.
        """
        noise, factor = self._of(views, seen.weights.shape[1])
        frames, count, _ = answers.points3d.shape
        columns = (SYMMETRIC, MODES) if modes else (0, 0)
        sds = np.full((frames, count), np.nan, np.float32)
        covariances = np.full((frames, count, columns[0]), np.nan, np.float32)
        shared = np.full((frames, count, 3, columns[1]), np.nan, np.float32)
        shapes = LearntShapes(self.mean, self.basis, self.variances)

        def write(part: slice) -> None:
            found = make_covariances(part.stop - part.start, shapes, factor, modes=modes)
            write_deviations(
                answers, rig, seen, detected, shapes, noise, factor,
                part.start, part.stop, found, sds,
            )  # fmt: skip
            if modes:
                covariances[part] = found.blocks[..., *np.triu_indices(3)]
                shared[part] = _leading(found)

        in_slices(frames, FRAMES_AT_A_TIME, write)
        return sds, covariances, shared

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


def _leading(found: Covariances) -> Float64:
    """Return the few modes (N, P, 3, MODES) that carry most of what the points of a frame share."""
    modes = np.concatenate((found.modes, found.by_cameras), -1)  # (N, P, 3, C)
    columns = modes.reshape(len(modes), -1, modes.shape[-1])
    known = np.all(np.isfinite(found.blocks), axis=(1, 2, 3))
    columns = np.where(known[:, None, None], columns, 0.0)
    _, turns = np.linalg.eigh(columns.mT @ columns)
    leading = np.zeros((*modes.shape[:3], MODES))
    most = turns[..., ::-1][..., :MODES]
    leading[..., : most.shape[-1]] = (columns @ most).reshape(*modes.shape[:3], -1)
    leading[~known] = np.nan
    return leading
