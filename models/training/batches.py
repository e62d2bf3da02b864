"""The batches of training steps: frames of the capture, and virtual views of teachers."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.instrumental_equations import NoisyFrames
from models.capture.observations import Observations
from models.network.losses import Batch
from models.training.teachers import Teachers
from models.training.virtual_views import drop_views, virtual_views

# Shares of a batch that virtual views take if all frames have a teacher, and if none has.
VIRTUAL_IF_TAUGHT, VIRTUAL_IF_NOT = 0.1, 0.5
# Weight of the weak-perspective reprojection error where teachers were refined in perspective.
TAUGHT_WEIGHT = 0.02
# Keypoints of all views, in frames that something is learnt from at the end: more add nothing.
DETECTIONS, FEWEST_FRAMES = 100_000, 100


class Data(NamedTuple):
    """Normalised keypoints of the N frames that a fit can use; see `Observations`."""

    keypoints: Tensor  # (N, K, P, 2)
    weights: Tensor  # (N, K, P)
    sizes: Tensor  # (N, K) pixels
    centres: Tensor  # (N, K, 2) pixels

    @classmethod
    def of(cls, observations: Observations, frames: NDArray[np.int64]) -> "Data":
        """Take some frames (N,) of a capture."""
        return cls(
            *(
                torch.from_numpy(part[frames])
                for part in (
                    observations.keypoints,
                    observations.weights,
                    observations.sizes,
                    observations.centres,
                )
            )
        )

    def pixels(self, frames: Tensor) -> Tensor:
        """Return keypoints (T, K, P, 2) of some frames (T,) in pixels, in float64."""
        sizes, centres = self.sizes[frames].double(), self.centres[frames].double()
        return self.keypoints[frames] * sizes[..., None, None] + centres[..., None, :]


class Batches:
    """Batches of `size` frames, or all, that depend on seed, step and teachers only."""

    def __init__(self, data: Data, *, size: int, seed: int) -> None:
        self._data = data
        self._size = min(size, len(data.keypoints))
        self._seed = seed
        self._epoch: tuple[int, NDArray[np.int64]] | None = None  # the last one and its order

    def draw(self, step: int, teachers: Teachers | None, *, perspective: bool) -> Batch:
        """Draw the batch of a step; `perspective` if teachers were refined in perspective."""
        frames = torch.from_numpy(self._frames(step))
        virtual = 0
        if teachers is not None:
            virtual = int(_virtual_share(teachers, perspective=perspective) * len(frames))
        own = len(frames) - virtual
        frames = frames[:own]
        data, size = self._data, self._size
        batch = Batch(
            keypoints=data.keypoints.new_empty(size, *data.keypoints.shape[1:]),
            weights=data.weights.new_empty(size, *data.weights.shape[1:]),
            sizes=data.sizes.new_zeros(size, data.sizes.shape[1]),
            factors=data.sizes.new_ones(size),
            teachers=data.sizes.new_zeros(size, data.weights.shape[2], 3),
            taught=data.sizes.new_zeros(size),
        )
        torch.index_select(data.keypoints, 0, frames, out=batch.keypoints[:own])
        torch.index_select(data.weights, 0, frames, out=batch.weights[:own])
        torch.index_select(data.sizes, 0, frames, out=batch.sizes[:own])
        if teachers is None:
            return batch

        rng = np.random.default_rng([self._seed, step, 1])
        views = virtual_views(teachers, data.weights, virtual, rng)
        batch.teachers[own:] = views.points
        batch.keypoints[own:] = views.keypoints
        batch.weights[own:] = views.weights
        batch.taught[own:] = 1
        taught = teachers.taught[frames].nonzero()[:, 0]
        batch.teachers[taught] = teachers.points[teachers.indices[frames[taught]]]
        batch.taught[taught] = 1
        if perspective:
            batch.weights[taught] = drop_views(batch.weights[taught], rng)
            batch.factors.sub_((1 - TAUGHT_WEIGHT) * batch.taught)
        return batch

    def _frames(self, step: int) -> NDArray[np.int64]:
        """Return the frames of a step: epoch after epoch, each in a new order."""
        epoch, place = divmod(step * self._size, len(self._data.keypoints))
        picked = self._order(epoch)[place : place + self._size]
        if len(picked) < self._size:
            picked = np.concatenate((picked, self._order(epoch + 1)[: self._size - len(picked)]))
        return picked

    def _order(self, epoch: int) -> NDArray[np.int64]:
        if self._epoch is None or self._epoch[0] != epoch:
            rng = np.random.default_rng([self._seed, epoch])
            self._epoch = (epoch, rng.permutation(len(self._data.keypoints)))
        return self._epoch[1]


def _virtual_share(teachers: Teachers, *, perspective: bool) -> float:
    """Return the share of a batch that virtual views take."""
    if not perspective:
        return VIRTUAL_IF_NOT
    taught = len(teachers.points) / len(teachers.taught)
    return VIRTUAL_IF_NOT + (VIRTUAL_IF_TAUGHT - VIRTUAL_IF_NOT) * taught


def noisy_frames(clear: Data, detected: Data, noise: float) -> NoisyFrames:
    """Return all frames before and after noise of so many pixels was removed."""
    every = torch.arange(len(clear.weights))
    return NoisyFrames(
        clear.pixels(every).double().numpy(),
        detected.pixels(every).double().numpy(),
        detected.weights.double().numpy(),
        noise,
    )


def enough_frames(views: int, keypoints: int, *, most: int) -> int:
    """Return how many frames of so many views and keypoints are enough to learn from."""
    return min(max(DETECTIONS // (views * keypoints), FEWEST_FRAMES), most)
