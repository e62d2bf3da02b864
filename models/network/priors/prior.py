"""The interface of shape priors, and what all of them have in common.

A prior encodes each view of a frame separately, into a code that does not depend on where the
camera was and a matrix near the camera's rotation. It decodes the mean code of the views into a
structure. It has two versions: in torch, differentiable and in batches, for training; and compiled,
frame by frame, for lifts. The mean over the views, hidden keypoints and cameras are the same for
all priors: they are here (torch) and in `models.network.feed_forward` (compiled).

A new prior is a file beside this one with a subclass of `Prior` and a tuple of weights, a line in
`models.network.priors.registry`, and its sizes in `models.settings.priors`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor, nn

from models.network.reprojection import fill, reproject
from models.numerics.tensor_files import Arrays


class Weights(Protocol):
    """The fields that every laid-out tuple of weights has besides those of its own functions."""

    @property
    def keypoints(self) -> int:
        """The number of keypoints P of a view."""

    @property
    def code_size(self) -> int:
        """The length B of a code."""


class Prior(nn.Module, ABC):
    """A shape prior of P keypoints with codes of B numbers, made as `Prior(keypoints, sizes)`."""

    # The NamedTuple that `lay_out` returns (see `Weights`), by whose type the compiled network
    # chooses the two functions below it. Both are compiled with `models.numerics.compiled.inner`.
    laid_out: ClassVar[type[Any]]
    # (weights, views (K, P, 2), codes (K, B), matrices (K, 2, 3)): writes the last two.
    encode_into: ClassVar[Callable[..., None]]
    # (weights, code (B,), points (P, 3)): writes the points, of any size and place.
    decode_into: ClassVar[Callable[..., None]]

    def __init__(self, keypoints: int, code_size: int) -> None:
        super().__init__()
        self.keypoints = keypoints
        self.code_size = code_size

    @abstractmethod
    def encode(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (M, B) of M normalised views (M, P, 2), and matrices (M, 2, 3) near rotations."""

    @abstractmethod
    def decode(self, code: Tensor) -> Tensor:
        """Canonical structures (N, P, 3) of codes (N, B), of any size and place."""

    @abstractmethod
    def width(self) -> int:
        """Numbers in the widest layer for one view; memory is proportional to it."""

    @abstractmethod
    def multiplications(self) -> int:
        """Multiplications of the encoder for a view, which are most of a step's."""

    @classmethod
    @abstractmethod
    def lay_out(cls, arrays: Arrays, sizes: Any) -> Weights:
        """Lay out the parameters, by name, as the compiled functions read them."""

    def initialise(self, seed: int) -> None:
        """Draw the weights anew from `seed`, leaving torch's own generator alone."""
        generator = torch.Generator().manual_seed(seed)
        for name, parameter in self.named_parameters():
            if parameter.ndim == 1:
                nn.init.zeros_(parameter)
            else:
                # Rows are the inputs of a layer, except in nn.Linear, which stores its transpose.
                fan_in = parameter.shape[1 if name.endswith("weight") else 0]
                nn.init.normal_(parameter, std=fan_in**-0.5, generator=generator)

    def reproject(self, keypoints: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruct frames from normalised keypoints (N, K, P, 2) with weights (N, K, P).

        Returns
        -------
        tuple
            Structures (N, P, 3), their projections (N, K, P, 2), and matrices (N, K, 2, 3) whose
            nearest rotations are first guesses of the cameras'.
        """
        votes = weights.sum(-1)  # (N, K)
        there = votes > 0
        # Pooling, paper eq. "pool", as a mean over the views that are there, weighted by how much
        # of the object each one shows: a sum would shrink the code when a view is missing.
        votes = (votes / votes.sum(-1, keepdim=True).clamp_min(1e-6))[:, None]  # (N, 1, K)

        nothing = keypoints.new_zeros
        codes = nothing(*there.shape, self.code_size)
        matrices = nothing(*there.shape, 2, 3)
        codes, matrices = self._read(keypoints, there, codes, matrices)
        points, projected = self._geometry(votes, codes, matrices, keypoints, weights)
        hidden = (weights < 1).any(-1) & there
        if hidden.any():
            # Hidden keypoints are filled with their reprojections, and the views are encoded again.
            filled = fill(projected, keypoints, weights)
            codes, matrices = self._read(filled, hidden, codes, matrices)
            points, projected = self._geometry(votes, codes, matrices, keypoints, weights)
        return points, projected, matrices

    def _read(
        self, seen: Tensor, which: Tensor, codes: Tensor, matrices: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Renew codes (N, K, B) and matrices (N, K, 2, 3) of the views `which` (N, K)."""
        views = seen.flatten(0, 1)
        if which.all():
            new_codes, new_matrices = self.encode(views)
        else:
            places = which.flatten().nonzero()[:, 0]
            parts = self.encode(views[places])
            new_codes = codes.flatten(0, 1).index_copy(0, places, parts[0])
            new_matrices = matrices.flatten(0, 1).index_copy(0, places, parts[1])
        return new_codes.view_as(codes), new_matrices.view_as(matrices)

    def _geometry(
        self, votes: Tensor, codes: Tensor, matrices: Tensor, keypoints: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        pooled = (votes @ codes)[:, 0]  # (N, B)
        return reproject(self.decode(pooled), matrices, keypoints, weights)
