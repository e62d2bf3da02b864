"""What each training step sees: frames of the capture, and virtual views of teachers."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capture.observations import Observations
from models.network.losses import Batch
from models.training.teachers import Teachers
from models.training.virtual_views import drop_views, virtual_views

VIRTUAL = (0.1, 0.5)  # shares of a batch that virtual views take, if all frames are taught or none
TAUGHT = 0.02  # weight of the (weak-perspective) reprojection error where teachers know perspective


class Data(NamedTuple):
    """Normalised keypoints of the N frames that a fit can use; see `Observations`."""

    keypoints: Tensor  # (N, K, P, 2)
    weights: Tensor  # (N, K, P)
    sizes: Tensor  # (N, K) pixels
    centres: Tensor  # (N, K, 2) pixels

    @classmethod
    def of(cls, seen: Observations, frames: NDArray[np.int64]) -> "Data":
        """Take some frames of a capture."""
        return cls(
            *(
                torch.from_numpy(part[frames])
                for part in (seen.keypoints, seen.weights, seen.sizes, seen.centres)
            )
        )

    def pixels(self, frames: Tensor) -> Tensor:
        """Keypoints (T, K, P, 2) of some frames in pixels, in float64."""
        sizes, centres = self.sizes[frames].double(), self.centres[frames].double()
        return self.keypoints[frames] * sizes[..., None, None] + centres[..., None, :]


class Batches:
    """Batches that are functions of seed, step and teachers only."""

    def __init__(self, data: Data, *, size: int, seed: int) -> None:
        self._data = data
        self._size = min(size, len(data.keypoints))
        self._seed = seed
        self._epoch = (-1, np.empty(0, np.int64))

    def draw(self, step: int, teachers: Teachers | None, *, perspective: bool) -> Batch:
        """Draw the batch of a step; `perspective` says that teachers were refined with it."""
        frames = torch.from_numpy(self._frames(step))
        virtual = 0
        if teachers is not None:
            taught = len(teachers.points) / len(teachers.places)
            share = VIRTUAL[1] + (VIRTUAL[0] - VIRTUAL[1]) * taught if perspective else VIRTUAL[1]
            virtual = int(share * len(frames))
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
        batch.teachers[own:], batch.keypoints[own:], batch.weights[own:] = virtual_views(
            teachers, data.weights, virtual, rng
        )
        batch.taught[own:] = 1
        places = teachers.places[frames]
        known = (places >= 0).nonzero()[:, 0]
        batch.teachers[known] = teachers.points[places[known]]
        batch.taught[known] = 1
        if perspective:
            batch.weights[known] = drop_views(batch.weights[known], rng)
            batch.factors.sub_((1 - TAUGHT) * batch.taught)
        return batch

    def _frames(self, step: int) -> NDArray[np.int64]:
        """Frames of this step: epoch after epoch, each in an order of its own."""
        epoch, place = divmod(step * self._size, len(self._data.keypoints))
        picked = self._order(epoch)[place : place + self._size]
        if len(picked) < self._size:
            picked = np.concatenate((picked, self._order(epoch + 1)[: self._size - len(picked)]))
        return picked

    def _order(self, epoch: int) -> NDArray[np.int64]:
        if epoch != self._epoch[0]:
            rng = np.random.default_rng([self._seed, epoch])
            self._epoch = (epoch, rng.permutation(len(self._data.keypoints)))
        return self._epoch[1]
