"""The posterior of a fit: what its lifts need to answer how far each point may be off."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import VIEW, Rig
from models.network.answers import Answers
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.posterior.answers import frames_of
from models.posterior.frames import Covariances, ShapeModel, covariances_of

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MOST_COMPONENTS, MOST_FACTORS = 64, 64  # that a file may hold


class Posterior(NamedTuple):
    """Shapes, noise and cameras of a fit of K views and P keypoints."""

    mean: Float64  # (P, 3) of `ShapeModel`
    basis: Float64  # (P, 3, Q)
    variances: Float64  # (P,)
    noise: Float64  # (K, P) pixels, of a coordinate of confidence 1
    factor: Float64  # (K, 11, T) the covariance of the cameras' numbers is L L^T

    def deviations(
        self,
        answers: Answers,
        rig: Rig,
        views: Sequence[int] | None,
        keypoints: Float64,
        weights: Float64,
    ) -> Float32:
        """Return the expected distance (N, P) of each point from the true one, root mean square.

        NaN for frames without a perspective camera. In the unit of the answers. A structure's place
        and direction are no part of it, nor is its size where no static rig gives it.

        Parameters
        ----------
        answers
            Refined ones with all their points.
        rig
            Of the K views of the answers.
        views
            Which views of the fit they are; None: cameras that it does not know.
        keypoints, weights
            (N, K, P, 2) pixels as they were detected, and (N, K, P) confidences, 0 where not used.
        """
        found = self.covariances(answers, rig, views, keypoints, weights, modes=False)
        variances = found.blocks.trace(axis1=2, axis2=3)
        placed: NDArray[np.bool_] = np.any(answers.camera_models > 0, axis=1)
        return np.where(placed[:, None], np.sqrt(variances.clip(0)), np.nan).astype(np.float32)

    def covariances(
        self,
        answers: Answers,
        rig: Rig,
        views: Sequence[int] | None,
        keypoints: Float64,
        weights: Float64,
        *,
        modes: bool = True,
    ) -> Covariances:
        """Return the covariances of a lift's points; parameters are those of `deviations`.

        Without `modes` only the blocks are filled.
        """
        count = answers.camera_models.shape[1]
        if views is None:
            noise = np.tile(np.sqrt(np.square(self.noise).mean(0)), (count, 1))
            factor = np.zeros((count, VIEW, 1))
        else:
            noise, factor = self.noise[list(views)], self.factor[list(views)]
        frames = frames_of(answers, rig, self.mean, keypoints, weights, noise)
        shapes = ShapeModel(self.mean, self.basis, self.variances)
        return covariances_of(frames, shapes, np.ascontiguousarray(factor), modes=modes)

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
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "Posterior":
        """Read what `to_arrays` returned.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        found = cls(
            *(np.ascontiguousarray(arrays[name].numpy(), np.float64) for name in cls._fields)
        )
        agree = (
            len(found.noise) == len(found.factor)
            and found.basis.shape[2] <= MOST_COMPONENTS
            and found.factor.shape[2] <= MOST_FACTORS
            and bool((found.variances > 0).all() and (found.noise > 0).all())
        )
        if not agree:
            raise WeightsError("the file contradicts itself about its posterior")
        return found
