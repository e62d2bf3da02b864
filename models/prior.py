"""The hierarchical neural shape prior: 2D keypoints of the views of a frame -> structure, cameras.

Dabhi, Wang, Saluja, Jeni, Fasel, Lucey: *High Fidelity 3D Reconstructions with Limited Physical
Views*, 3DV 2021; "paper" below. Read top to bottom: encoder, rotation factorisation, pooling,
decoder, cameras.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from models.cameras import WeakPerspective, nearest_rotation, project, solve_cameras


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
        """Codes (M, B_L) and rotations (M, 3, 3) of M centred views (M, P, 2)."""
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
        rotations, _ = nearest_rotation(self.rotate(flat).reshape(-1, 2, 3))
        code: Tensor = self.unrotate(flat)
        return code, rotations

    def decode(self, code: Tensor) -> Tensor:
        """Canonical structures (N, P, 3), centred, root-mean-square radius 1, of codes (N, B_L)."""
        # Paper eq. "decoder": phi_{l-1} = ReLU(D_l phi_l; lambda_l), S = D_1 phi_1.
        for dictionary, threshold in zip(
            reversed(self.dictionaries), reversed(self.decoder_thresholds), strict=True
        ):
            code = torch.relu_(torch.addmm(-threshold, code, dictionary.T))  # (N, B_{l-1})
        atoms = self.first.reshape(3 * self.keypoints, -1)  # (3 P, B_1)
        points = (code @ atoms.T).reshape(-1, self.keypoints, 3)
        points = points - points.mean(-2, keepdim=True)
        radius = points.square().sum(-1).mean(-1).clamp_min(1e-12).sqrt()
        return points / radius[:, None, None]

    def forward(self, keypoints: Tensor, weights: Tensor) -> Reconstruction:
        """Reconstruct frames from normalised keypoints (N, K, P, 2) with weights (N, K, P)."""
        result = self._reconstruct(keypoints, keypoints, weights)
        hidden = (weights < 1) & (weights.sum(-1, keepdim=True) > 0)
        if hidden.any():
            # What is hidden is filled with its reprojection and the views are read once more.
            filled = weights[..., None] * keypoints + (1 - weights[..., None]) * project(
                result.points[:, None], result.cameras
            )
            filled = filled - filled.mean(-2, keepdim=True)
            size = filled.square().sum(-1).mean(-1).clamp_min(1e-12).sqrt()
            filled = filled / size[..., None, None]
            result = self._reconstruct(filled, keypoints, weights)
        return result

    def _reconstruct(self, seen: Tensor, keypoints: Tensor, weights: Tensor) -> Reconstruction:
        frames, views = seen.shape[:2]
        codes, guesses = self.encode(seen.flatten(0, 1))
        guesses = guesses.reshape(frames, views, 3, 3)
        # Pooling, paper eq. "pool", as a mean over the views that are there, weighted by how much
        # of the object each one shows: a sum would shrink the code when a view is missing.
        votes = weights.sum(-1)  # (N, K)
        votes = votes / votes.sum(-1, keepdim=True).clamp_min(1e-6)
        code = (votes[..., None] * codes.reshape(frames, views, codes.shape[-1])).sum(1)  # (N, B_L)
        points = self.decode(code)
        cameras = solve_cameras(points[:, None], keypoints, weights, guesses)
        return Reconstruction(points, cameras, guesses)


def parameter_shapes(keypoints: int, sizes: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """Name and shape of every parameter of such a prior, without allocating any."""
    with torch.device("meta"):
        network = HierarchicalPrior(keypoints, sizes)
    return {name: tuple(value.shape) for name, value in network.named_parameters()}
