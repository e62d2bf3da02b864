"""The hierarchical neural shape prior: 2D keypoints of the views of a frame -> structure, cameras.

Dabhi, Wang, Saluja, Jeni, Fasel, Lucey: *High Fidelity 3D Reconstructions with Limited Physical
Views*, 3DV 2021; "paper" below. Read top to bottom: encoder, rotation factorisation, pooling,
decoder, cameras.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.network.reprojection import fill, reproject
from models.optics.weak_perspective import WeakPerspective, nearest_rotation, solve_cameras


class Reconstruction(NamedTuple):
    """What the prior sees in N frames of K views."""

    points: Tensor  # (N, P, 3) canonical structure, centred, root-mean-square radius 1
    cameras: WeakPerspective  # (N, K)
    guesses: Tensor  # (N, K, 3, 3) the rotations that the encoder factored out


class HierarchicalPrior(nn.Module):
    """Dictionaries of L layers, shared by encoder and decoder, with their sparsity thresholds."""

    def __init__(self, keypoints: int, sizes: tuple[int, ...]) -> None:
        super().__init__()
        self.keypoints = keypoints
        layers = range(1, len(sizes))
        # D_1 is (P, 3 B_1), one 3D point per keypoint and atom; D_l is (B_{l-1}, B_l).
        self.first = nn.Parameter(torch.empty(keypoints, 3 * sizes[0]))
        self.dictionaries = nn.ParameterList(torch.empty(sizes[i - 1], sizes[i]) for i in layers)
        self.encoder_thresholds = nn.ParameterList(torch.empty(size) for size in sizes)
        self.decoder_thresholds = nn.ParameterList(torch.empty(sizes[i - 1]) for i in layers)
        self.unrotate = nn.Linear(6 * sizes[-1], sizes[-1])
        self.rotate = nn.Linear(6 * sizes[-1], 6)

    def initialise(self, seed: int) -> None:
        """Draw the weights anew from `seed`, leaving torch's own generator alone."""
        generator = torch.Generator().manual_seed(seed)
        for name, parameter in self.named_parameters():
            if parameter.ndim == 1:
                nn.init.zeros_(parameter)
            else:
                # Rows are what a layer reads, save for nn.Linear, which stores its transpose.
                fan_in = parameter.shape[1 if name.endswith("weight") else 0]
                nn.init.normal_(parameter, std=fan_in**-0.5, generator=generator)

    def widest(self, weights: Tensor) -> int:
        """Numbers in a sixth of the widest layer for one frame of `weights` (N, K, P)."""
        return weights.shape[1] * max(weights.shape[2], len(self.encoder_thresholds[0]))

    def encode(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (M, B_L) of M centred views (M, P, 2), and matrices (M, 2, 3) near rotations."""
        # One ISTA step per layer, paper eq. "encoder": Psi_l = ReLU(D_l^T Psi_{l-1}; lambda_l).
        # The six numbers of an atom's 2x3 block are rows of their own, so that a layer is one
        # product; addmm with relu_ halves the memory traffic that dominates on a CPU.
        rows = views.mT.reshape(-1, self.keypoints)  # (2 M, P)
        threshold = self.encoder_thresholds[0].repeat(3)
        block = torch.relu_(torch.addmm(-threshold, rows, self.first))  # (2 M, 3 B_1)
        block = block.reshape(6 * len(views), len(self.encoder_thresholds[0]))  # (6 M, B_1)
        for dictionary, threshold in zip(
            self.dictionaries, self.encoder_thresholds[1:], strict=True
        ):
            block = torch.relu_(torch.addmm(-threshold, block, dictionary))  # (6 M, B_l)
        # Rotation factorisation: one linear layer reads the unrotated code, one the rotation.
        flat = block.reshape(len(views), 6 * block.shape[-1])  # (M, 6 B_L)
        return self.unrotate(flat), self.rotate(flat).reshape(-1, 2, 3)

    def decode(self, code: Tensor) -> Tensor:
        """Canonical structures (N, P, 3) of codes (N, B_L), of any size and place."""
        # Paper eq. "decoder": phi_{l-1} = ReLU(D_l phi_l; lambda_l), S = D_1 phi_1.
        for dictionary, threshold in zip(
            reversed(self.dictionaries), reversed(self.decoder_thresholds), strict=True
        ):
            code = torch.relu_(torch.addmm(-threshold, code, dictionary.T))  # (N, B_{l-1})
        atoms = self.first.reshape(3 * self.keypoints, -1)  # (3 P, B_1)
        return (code @ atoms.T).reshape(-1, self.keypoints, 3)

    def forward(self, keypoints: Tensor, weights: Tensor) -> Reconstruction:
        """Reconstruct frames from normalised keypoints (N, K, P, 2) with weights (N, K, P)."""
        points, _, turns = self.reproject(keypoints, weights)
        guesses, _ = nearest_rotation(turns)
        cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
        return Reconstruction(points, cameras, guesses)

    def reproject(self, keypoints: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reconstruct frames as `forward` does, as far as training needs it.

        Returns
        -------
        tuple
            Structures (N, P, 3), their projections (N, K, P, 2), and matrices (N, K, 2, 3) whose
            nearest rotations are the guesses.
        """
        votes = weights.sum(-1)  # (N, K)
        there = votes > 0
        # Pooling, paper eq. "pool", as a mean over the views that are there, weighted by how much
        # of the object each one shows: a sum would shrink the code when a view is missing.
        votes = (votes / votes.sum(-1, keepdim=True).clamp_min(1e-6))[:, None]  # (N, 1, K)

        nothing = keypoints.new_zeros
        codes = nothing(*there.shape, len(self.unrotate.bias))
        turns = nothing(*there.shape, 2, 3)
        codes, turns = self._read(keypoints, there, codes, turns)
        points, projected = self._geometry(votes, codes, turns, keypoints, weights)
        hidden = (weights < 1).any(-1) & there
        if hidden.any():
            # What is hidden is filled with its reprojection and the views are read once more.
            filled = fill(projected, keypoints, weights)
            codes, turns = self._read(filled, hidden, codes, turns)
            points, projected = self._geometry(votes, codes, turns, keypoints, weights)
        return points, projected, turns

    def _read(
        self, seen: Tensor, which: Tensor, codes: Tensor, turns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Renew codes (N, K, B_L) and matrices (N, K, 2, 3) of the views `which` (N, K)."""
        views = seen.flatten(0, 1)
        if which.all():
            new_codes, new_turns = self.encode(views)
        else:
            places = which.flatten().nonzero()[:, 0]
            parts = self.encode(views[places])
            new_codes = codes.flatten(0, 1).index_copy(0, places, parts[0])
            new_turns = turns.flatten(0, 1).index_copy(0, places, parts[1])
        return new_codes.view_as(codes), new_turns.view_as(turns)

    def _geometry(
        self, votes: Tensor, codes: Tensor, turns: Tensor, keypoints: Tensor, weights: Tensor
    ) -> tuple[Tensor, Tensor]:
        pooled = (votes @ codes)[:, 0]  # (N, B_L)
        return reproject(self.decode(pooled), turns, keypoints, weights)


def multiplications(views: int, keypoints: int, sizes: tuple[int, ...]) -> int:
    """Return about how many multiplications the encoder takes for a frame, which are most."""
    layers = pairwise(sizes)
    return views * (6 * keypoints * sizes[0] + 6 * sum(outer * inner for outer, inner in layers))


def parameter_shapes(keypoints: int, sizes: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter of such a prior, without allocating any."""
    with torch.device("meta"):
        network = HierarchicalPrior(keypoints, sizes)
    return {name: tuple(value.shape) for name, value in network.named_parameters()}
