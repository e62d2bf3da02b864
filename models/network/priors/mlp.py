"""The prior `mlp`: a plain encoder of residual blocks, and a plain decoder.

It is there to compare the hierarchical prior with. A view is one row of 2 P numbers; a block is
h + W_2 GELU(W_1 LayerNorm(h)). LayerNorm has no weights of its own: the next layer would absorb
them.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import gelu, layer_norm

from models.network.priors.layers import Float32, affine_into
from models.network.priors.prior import Prior
from models.numerics.compiled import inner
from models.numerics.tensor_files import Arrays
from models.settings.priors import MlpSizes

EPSILON = 1e-5  # added to the variance under LayerNorm's root
HALF, ONE, ROOT_HALF = np.float32(0.5), np.float32(1), np.float32(math.sqrt(0.5))


class MlpWeights(NamedTuple):
    """The parameters of an `MlpPrior`, laid out for the compiled functions: matrices transposed."""

    keypoints: int
    code_size: int
    entry: Float32  # (2 P, W)
    entry_bias: Float32  # (W,)
    blocks: Float32  # (L, 2, W, W) the two layers of each block
    block_biases: Float32  # (L, 2, W)
    heads: Float32  # (W, B + 6) code, then rotation
    head_bias: Float32  # (B + 6,)
    hidden: Float32  # (B, W); (B, 0) of a linear decoder
    hidden_bias: Float32  # (W,) or (0,)
    basis: Float32  # (W, 3 P); (B, 3 P) of a linear decoder
    mean: Float32  # (3 P,)


@inner
def _encode_into(
    weights: MlpWeights, views: Float32, codes: Float32, matrices: NDArray[np.float64]
) -> None:
    """Compute `MlpPrior.encode` for the K views of a frame."""
    count, keypoints, _ = views.shape
    width = len(weights.entry_bias)
    rows = np.empty((count, 2 * keypoints), np.float32)
    for k in range(count):
        for p in range(keypoints):
            rows[k, 2 * p], rows[k, 2 * p + 1] = views[k, p, 0], views[k, p, 1]
    state = np.empty((count, width), np.float32)
    normal, change = np.empty_like(state), np.empty_like(state)
    affine_into(rows, weights.entry, weights.entry_bias, state)
    for block in range(len(weights.blocks)):
        _layer_norm_into(state, normal)
        affine_into(normal, weights.blocks[block, 0], weights.block_biases[block, 0], change)
        _apply_gelu(change)
        affine_into(change, weights.blocks[block, 1], weights.block_biases[block, 1], normal)
        for k in range(count):
            for i in range(width):
                state[k, i] += normal[k, i]
    _layer_norm_into(state, normal)
    size = weights.code_size
    read = np.empty((count, size + 6), np.float32)
    affine_into(normal, weights.heads, weights.head_bias, read)
    for k in range(count):
        for i in range(size):
            codes[k, i] = read[k, i]
        for i in range(6):
            matrices[k, i // 3, i % 3] = read[k, size + i]


@inner
def _decode_into(weights: MlpWeights, code: Float32, points: NDArray[np.float64]) -> None:
    """Compute `MlpPrior.decode` for one code."""
    row = code.reshape(1, len(code))
    if len(weights.hidden_bias):
        wide = np.empty((1, len(weights.hidden_bias)), np.float32)
        affine_into(row, weights.hidden, weights.hidden_bias, wide)
        _apply_gelu(wide)
        row = wide
    flat = np.empty((1, len(weights.mean)), np.float32)
    affine_into(row, weights.basis, weights.mean, flat)
    for p in range(len(points)):
        for i in range(3):
            points[p, i] = flat[0, 3 * p + i]


@inner
def _layer_norm_into(rows: Float32, out: Float32) -> None:
    """Bring each row (n, W) to mean 0 and variance 1."""
    width = rows.shape[1]
    for k in range(len(rows)):
        mean, variance = 0.0, 0.0
        for i in range(width):
            mean += rows[k, i]
        mean /= width
        for i in range(width):
            variance += (rows[k, i] - mean) ** 2
        scale = 1 / math.sqrt(variance / width + EPSILON)
        for i in range(width):
            out[k, i] = (rows[k, i] - mean) * scale


@inner
def _apply_gelu(rows: Float32) -> None:
    """Replace x by x times the probability that a standard normal number lies below it."""
    for k in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            x = rows[k, i]
            rows[k, i] = HALF * x * (ONE + math.erf(x * ROOT_HALF))


class MlpPrior(Prior):
    """An encoder of residual blocks of W numbers, and a decoder that is linear or has one layer."""

    laid_out = MlpWeights
    encode_into = staticmethod(_encode_into)
    decode_into = staticmethod(_decode_into)

    def __init__(self, keypoints: int, sizes: MlpSizes) -> None:
        super().__init__(keypoints, code_size=sizes.code)
        width = sizes.width
        self.sizes = sizes
        self.entry = nn.Linear(2 * keypoints, width)
        self.blocks = nn.ModuleList(nn.Linear(width, width) for _ in range(2 * sizes.blocks))
        self.unrotate = nn.Linear(width, sizes.code)
        self.rotate = nn.Linear(width, 6)
        self.hidden = nn.Linear(sizes.code, width) if sizes.decoder == "mlp" else None
        self.basis = nn.Linear(sizes.code if self.hidden is None else width, 3 * keypoints)

    def encode(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (M, B) of M normalised views (M, P, 2), and matrices (M, 2, 3) near rotations."""
        state, width = self.entry(views.flatten(1)), self.sizes.width  # (M, W)
        for first, second in zip(self.blocks[::2], self.blocks[1::2], strict=True):
            state = state + second(gelu(first(_normalised(state, width))))
        state = _normalised(state, width)
        return self.unrotate(state), self.rotate(state).reshape(-1, 2, 3)

    def decode(self, code: Tensor) -> Tensor:
        """Canonical structures (N, P, 3) of codes (N, B), of any size and place."""
        if self.hidden is not None:
            code = gelu(self.hidden(code))  # (N, W)
        flat: Tensor = self.basis(code)  # (N, 3 P)
        return flat.reshape(-1, self.keypoints, 3)

    def width(self) -> int:
        """Numbers of the widest layer for one view."""
        return max(self.sizes.width, 2 * self.keypoints)

    def multiplications(self) -> int:
        """Multiplications of the encoder for a view."""
        layers = (self.entry, *self.blocks, self.unrotate, self.rotate)
        return sum(layer.weight.numel() for layer in layers)

    @classmethod
    def lay_out(cls, arrays: Arrays, sizes: MlpSizes) -> MlpWeights:
        """Lay out the parameters, by name, for the compiled functions."""
        # nn.Linear stores the transpose of what rows are multiplied by.
        a = {n: np.ascontiguousarray(part.numpy().T, np.float32) for n, part in arrays.items()}
        width, code, blocks = sizes.width, sizes.code, range(2 * sizes.blocks)
        nothing = np.zeros((0, width, width), np.float32)
        matrices = [a[f"blocks.{i}.weight"][None] for i in blocks]
        biases = [a[f"blocks.{i}.bias"][None] for i in blocks]
        return MlpWeights(
            len(a["basis.bias"]) // 3,
            code,
            a["entry.weight"],
            a["entry.bias"],
            np.concatenate([nothing, *matrices]).reshape(-1, 2, width, width),
            np.concatenate([nothing[:, 0], *biases]).reshape(-1, 2, width),
            np.concatenate((a["unrotate.weight"], a["rotate.weight"]), 1),
            np.concatenate((a["unrotate.bias"], a["rotate.bias"])),
            a.get("hidden.weight", np.zeros((code, 0), np.float32)),
            a.get("hidden.bias", np.zeros(0, np.float32)),
            a["basis.weight"],
            a["basis.bias"],
        )


def _normalised(rows: Tensor, width: int) -> Tensor:
    return layer_norm(rows, (width,), eps=EPSILON)
