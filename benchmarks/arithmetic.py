"""The feed-forward arithmetic of a lift, in a form that any runtime takes, and what it costs.

`models.network.priors` explains the computation. Here it has no branches, no
gradients and its constants are folded, so that it can be traced, exported and compared.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch

RIDGE, TINY = 1e-4, 1e-12  # as in models.optics.weak_perspective
FLOAT_BYTES = 4

Array = Any  # of NumPy or torch


@dataclass(frozen=True)
class Library:
    """What NumPy and torch call differently."""

    stack: Callable[[list[Array], int], Array]  # along an axis
    affine: Callable[[Array, Array, Array], Array]  # bias, rows, matrix -> rows @ matrix + bias
    relu: Callable[[Array], Array]  # may overwrite its argument


TORCH = Library(torch.stack, torch.addmm, torch.relu_)
NUMPY = Library(
    np.stack,
    lambda bias, rows, matrix: np.add(product := rows @ matrix, bias, out=product),
    lambda x: np.maximum(x, 0, out=x),
)


@dataclass(frozen=True)
class Constants:
    """Weights as the arithmetic reads them; sizes B_1 to B_L."""

    encoder: list[tuple[Array, Array]]  # (B_{l-1}, B_l) and minus the thresholds; first (P, 3 B_1)
    heads: Array  # (6 B_L, B_L + 6) code and rotation
    head_bias: Array
    decoder: list[tuple[Array, Array]]  # (B_l, B_{l-1}) and minus the thresholds, from the code on
    atoms: Array  # (B_1, 3 P)


def fold(weights: dict[str, Array], layers: int, join: Callable[[list[Array]], Array]) -> Constants:
    """Lay out the arrays of a model's weights file; `join` concatenates along the first axis."""
    first = weights["first"]
    inner = [weights[f"dictionaries.{layer}"] for layer in range(layers - 1)]
    encoder = [-weights[f"encoder_thresholds.{layer}"] for layer in range(layers)]
    decoder = [-weights[f"decoder_thresholds.{layer}"] for layer in range(layers - 1)]
    return Constants(
        [(first, join([encoder[0]] * 3)), *zip(inner, encoder[1:], strict=True)],
        join([weights["unrotate.weight"], weights["rotate.weight"]]).T,
        join([weights["unrotate.bias"], weights["rotate.bias"]]),
        [(matrix.T, bias) for matrix, bias in zip(inner[::-1], decoder[::-1], strict=True)],
        first.reshape(3 * first.shape[0], -1).T,
    )


def feed_forward(
    library: Library, constants: Constants, keypoints: Array, weights: Array
) -> tuple[Array, Array, Array, Array]:
    """Encode, pool, decode, find cameras.

    Parameters
    ----------
    keypoints, weights
        (N, K, P, 2) normalised and (N, K, P), every view showing something.

    Returns
    -------
    Points (N, P, 3), the first two rows of the rotations (N, K, 2, 3), scales (N, K) and
    translations (N, K, 2), in units of the normalised keypoints.
    """
    _, views, count, _ = keypoints.shape
    size = constants.encoder[-1][0].shape[1]
    block = keypoints.swapaxes(-1, -2).reshape(-1, count)  # (2 N K, P)
    for matrix, bias in constants.encoder:
        block = block.reshape(-1, matrix.shape[0])  # (6 N K, B)
        block = library.relu(library.affine(bias, block, matrix))
    heads = library.affine(constants.head_bias, block.reshape(-1, 6 * size), constants.heads)
    heads = heads.reshape(-1, views, size + 6)
    guess = _nearest(library, heads[..., size : size + 3], heads[..., size + 3 :])
    votes = weights.sum(-1)
    votes = votes / votes.sum(-1)[..., None]
    code = (votes[..., None] * heads[..., :size]).sum(1)
    for matrix, bias in constants.decoder:
        code = library.relu(library.affine(bias, code, matrix))
    points = (code @ constants.atoms).reshape(-1, count, 3)
    points = points - points.mean(1)[:, None]
    points = points / (points**2).sum(-1).mean(-1)[:, None, None] ** 0.5
    return (points, *_cameras(library, points[:, None], keypoints, weights, guess))


def _cameras(
    library: Library, points: Array, image: Array, weights: Array, guess: Array
) -> tuple[Array, Array, Array]:
    """As `models.optics.weak_perspective.solve_camera_into`; points (N, 1, P, 3)."""
    share = (weights / weights.sum(-1)[..., None])[..., None]  # (N, K, P, 1)
    centre, middle = (share * points).sum(-2), (share * image).sum(-2)  # (N, K, 3), (N, K, 2)
    points, image = points - centre[..., None, :], image - middle[..., None, :]
    weighted = (share * points).swapaxes(-1, -2)  # (N, K, 3, P)
    scatter, cross = weighted @ points, weighted @ image  # (N, K, 3, 3), (N, K, 3, 2)
    variance = (share * points**2).sum(-1).sum(-1) + TINY  # (N, K)
    spread = (share * image**2).sum(-1).sum(-1)
    ridge = RIDGE * variance
    pull = ridge * (spread / variance + TINY) ** 0.5
    a, b, c = scatter[..., 0, :], scatter[..., 1, :], scatter[..., 2, :]
    a = library.stack([a[..., 0] + ridge, a[..., 1], a[..., 2]], -1)
    b = library.stack([b[..., 0], b[..., 1] + ridge, b[..., 2]], -1)
    c = library.stack([c[..., 0], c[..., 1], c[..., 2] + ridge], -1)
    inverse = library.stack(
        [_cross(library, b, c), _cross(library, c, a), _cross(library, a, b)], -1
    )
    determinant = (a * inverse[..., 0]).sum(-1)  # (N, K)
    right = cross + pull[..., None, None] * guess.swapaxes(-1, -2)
    affine = (inverse @ right) / determinant[..., None, None]  # (N, K, 3, 2)
    axes = _nearest(library, affine[..., 0], affine[..., 1]).swapaxes(-1, -2)  # (N, K, 3, 2)
    scales = (cross * axes).sum(-1).sum(-1) / ((scatter @ axes) * axes).sum(-1).sum(-1)
    offset = (centre[..., None, :] @ axes)[..., 0, :]
    return axes.swapaxes(-1, -2), scales, middle - scales[..., None] * offset


def _nearest(library: Library, first: Array, second: Array) -> Array:
    """Orthonormal rows (..., 2, 3) nearest to two vectors (..., 3); see `weak_perspective`."""
    a = (first**2).sum(-1)[..., None] ** 0.5
    x = first / a
    b = (x * second).sum(-1)[..., None]
    y = second - b * x
    d = (y**2).sum(-1)[..., None] ** 0.5
    y = y / d
    stretch = ((a + d) ** 2 + b**2) ** 0.5
    cos, sin = (a + d) / stretch, b / stretch
    return library.stack([cos * x - sin * y, sin * x + cos * y], -2)


def _cross(library: Library, a: Array, b: Array) -> Array:
    parts = [
        a[..., (i + 1) % 3] * b[..., (i + 2) % 3] - a[..., (i + 2) % 3] * b[..., (i + 1) % 3]
        for i in range(3)
    ]
    return library.stack(parts, -1)


def products(views: int, keypoints: int, sizes: tuple[int, ...]) -> list[tuple[int, int, int]]:
    """Return the matrix products of one frame: (rows, inner, columns) from left to right."""
    encoder = [(6 * views, outer, inner) for outer, inner in pairwise(sizes)]
    decoder = [(1, inner, outer) for outer, inner in pairwise(sizes)]
    last = sizes[-1]
    return [
        (2 * views, keypoints, 3 * sizes[0]),
        *encoder,
        (views, 6 * last, last + 6),
        *decoder[::-1],
        (1, sizes[0], 3 * keypoints),
    ]


def flops(views: int, keypoints: int, sizes: tuple[int, ...]) -> int:
    """Return the floating-point operations of one frame; a multiplication and an addition are two.

    The cameras are counted from the sums in `_cameras`: about 75 for each keypoint of each view,
    and 300 for each view's 3x3 system.
    """
    dense = sum(
        2 * rows * inner * columns for rows, inner, columns in products(views, keypoints, sizes)
    )
    return dense + views * (75 * keypoints + 300)


def weight_bytes(keypoints: int, sizes: tuple[int, ...]) -> int:
    """Return the bytes of the weights, which stay in a cache from frame to frame."""
    numbers = 3 * keypoints * sizes[0] + sum(a * b for a, b in pairwise(sizes))
    numbers += (6 * sizes[-1] + 1) * (sizes[-1] + 6) + 2 * sum(sizes) + sizes[0]
    return FLOAT_BYTES * numbers


def frame_bytes(views: int, keypoints: int) -> int:
    """Return the bytes of one frame that come from memory and go there: input and answer."""
    seen = views * keypoints * 3
    answer = 3 * keypoints + views * (6 + 1 + 2)
    return FLOAT_BYTES * (seen + answer)
