"""The prior `hierarchical`: dictionaries of several layers, block-sparse.

Dabhi, Wang, Saluja, Jeni, Fasel, Lucey: *High Fidelity 3D Reconstructions with Limited Physical
Views*, 3DV 2021; "paper" below. Read top to bottom: encoder, rotation factorisation, decoder; then
the same once more, compiled.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from models.network.priors.layers import Float32, affine_into
from models.network.priors.prior import Prior
from models.numerics.compiled import inner, reordered
from models.numerics.tensor_files import Arrays


class DictionaryWeights(NamedTuple):
    """The parameters of a `HierarchicalPrior`, laid out for the compiled functions."""

    keypoints: int
    code_size: int
    sizes: NDArray[np.int64]  # (L,) atoms of each layer
    first: Float32  # (P, 3 B_1)
    atoms: Float32  # (3 P, B_1) the same numbers
    dictionaries: Float32  # D_2, D_3, ... one after the other, each (B_{l-1}, B_l)
    encoder_biases: Float32  # minus the thresholds: of the first layer three times, of the others
    decoder_thresholds: Float32
    heads: Float32  # (B_L + 6, 6 B_L) code, then rotation
    biases: Float32  # (B_L + 6,)


@inner
def _encode_into(
    weights: DictionaryWeights, views: Float32, codes: Float32, matrices: NDArray[np.float64]
) -> None:
    """Compute `HierarchicalPrior.encode` for the K views of a frame."""
    count, keypoints, _ = views.shape
    sizes = weights.sizes
    rows = np.empty((2 * count, keypoints), np.float32)
    for k in range(count):
        for p in range(keypoints):
            rows[2 * k, p], rows[2 * k + 1, p] = views[k, p, 0], views[k, p, 1]
    width = 3 * sizes[0]
    block = np.empty((2 * count, width), np.float32)
    affine_into(rows, weights.first, weights.encoder_biases[:width], block)
    _rectify(block)
    block = block.reshape(6 * count, sizes[0])
    start, bias = 0, width
    for layer in range(1, len(sizes)):
        m, b = sizes[layer - 1], sizes[layer]
        dictionary = weights.dictionaries[start : start + m * b].reshape(m, b)
        narrower = np.empty((6 * count, b), np.float32)
        affine_into(block, dictionary, weights.encoder_biases[bias : bias + b], narrower)
        _rectify(narrower)
        block, start, bias = narrower, start + m * b, bias + b
    size = weights.code_size
    flat = block.reshape(count, 6 * size)
    for k in range(count):
        for i in range(size):
            codes[k, i] = _dot(weights.heads[i], flat[k]) + weights.biases[i]
        for i in range(6):
            matrices[k, i // 3, i % 3] = (
                _dot(weights.heads[size + i], flat[k]) + weights.biases[size + i]
            )


@inner
def _decode_into(weights: DictionaryWeights, code: Float32, points: NDArray[np.float64]) -> None:
    """Compute `HierarchicalPrior.decode` for one code."""
    sizes = weights.sizes
    threshold, start = len(weights.decoder_thresholds), len(weights.dictionaries)
    for layer in range(len(sizes) - 1, 0, -1):
        m, b = sizes[layer - 1], sizes[layer]
        start, threshold = start - m * b, threshold - m
        dictionary = weights.dictionaries[start : start + m * b].reshape(m, b)
        wider = np.empty(m, np.float32)
        for i in range(m):
            value = _dot(dictionary[i], code) - weights.decoder_thresholds[threshold + i]
            wider[i] = max(value, np.float32(0))
        code = wider
    for p in range(len(points)):
        for i in range(3):
            points[p, i] = _dot(weights.atoms[3 * p + i], code)


@inner
def _rectify(block: Float32) -> None:
    """Set negative numbers to zero; thresholds were subtracted before."""
    for i in range(block.shape[0]):
        for j in range(block.shape[1]):
            block[i, j] = max(block[i, j], np.float32(0))


@reordered
def _dot(a: Float32, b: Float32) -> np.float32:
    summed = np.float32(0)
    for i in range(len(a)):
        summed += a[i] * b[i]
    return summed


class HierarchicalPrior(Prior):
    """Dictionaries of L layers, shared by encoder and decoder, with their sparsity thresholds."""

    laid_out = DictionaryWeights
    encode_into = staticmethod(_encode_into)
    decode_into = staticmethod(_decode_into)

    def __init__(self, keypoints: int, sizes: tuple[int, ...]) -> None:
        super().__init__(keypoints, code_size=sizes[-1])
        layers = range(1, len(sizes))
        self.sizes = sizes
        # D_1 is (P, 3 B_1), one 3D point per keypoint and atom; D_l is (B_{l-1}, B_l).
        self.first = nn.Parameter(torch.empty(keypoints, 3 * sizes[0]))
        self.dictionaries = nn.ParameterList(torch.empty(sizes[i - 1], sizes[i]) for i in layers)
        self.encoder_thresholds = nn.ParameterList(torch.empty(size) for size in sizes)
        self.decoder_thresholds = nn.ParameterList(torch.empty(sizes[i - 1]) for i in layers)
        self.unrotate = nn.Linear(6 * sizes[-1], sizes[-1])
        self.rotate = nn.Linear(6 * sizes[-1], 6)

    def encode(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (M, B_L) of M centred views (M, P, 2), and matrices (M, 2, 3) near rotations."""
        # One ISTA step per layer, paper eq. "encoder": Psi_l = ReLU(D_l^T Psi_{l-1}; lambda_l).
        # The six numbers of an atom's 2x3 block are rows of their own, so that a layer is one
        # product; addmm with relu_ halves the memory traffic that dominates on a CPU.
        rows = views.transpose(-1, -2).reshape(-1, self.keypoints)  # (2 M, P)
        threshold = self.encoder_thresholds[0].repeat(3)
        block = torch.relu_(torch.addmm(-threshold, rows, self.first))  # (2 M, 3 B_1)
        block = block.reshape(6 * views.shape[0], self.sizes[0])  # (6 M, B_1)
        for dictionary, threshold in zip(
            self.dictionaries, self.encoder_thresholds[1:], strict=True
        ):
            block = torch.relu_(torch.addmm(-threshold, block, dictionary))  # (6 M, B_l)
        # Rotation factorisation: one linear layer reads the unrotated code, one the rotation.
        flat = block.reshape(views.shape[0], 6 * block.shape[-1])  # (M, 6 B_L)
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

    def width(self) -> int:
        """Numbers of the first layer, whose rows are six for a view."""
        return 6 * max(self.keypoints, self.sizes[0])

    def multiplications(self) -> int:
        """Multiplications of the encoder for a view."""
        inner_layers = sum(outer * inner for outer, inner in pairwise(self.sizes))
        heads = self.sizes[-1] * (self.sizes[-1] + 6)
        return 6 * (self.keypoints * self.sizes[0] + inner_layers + heads)

    @classmethod
    def lay_out(cls, arrays: Arrays, sizes: tuple[int, ...]) -> DictionaryWeights:
        """Lay out the parameters, by name, for the compiled functions."""
        a = {name: np.ascontiguousarray(part.numpy(), np.float32) for name, part in arrays.items()}
        layers = range(1, len(sizes))
        nothing = np.zeros(0, np.float32)
        keypoints = len(a["first"])
        thresholds = [a[f"encoder_thresholds.{i}"] for i in range(len(sizes))]
        return DictionaryWeights(
            keypoints,
            sizes[-1],
            np.array(sizes),
            a["first"],
            a["first"].reshape(3 * keypoints, -1),
            np.concatenate([nothing, *(a[f"dictionaries.{i - 1}"].ravel() for i in layers)]),
            -np.concatenate([np.tile(thresholds[0], 3), *thresholds[1:]]),
            np.concatenate([nothing, *(a[f"decoder_thresholds.{i - 1}"] for i in layers)]),
            np.concatenate((a["unrotate.weight"], a["rotate.weight"])),
            np.concatenate((a["unrotate.bias"], a["rotate.bias"])),
        )
