"""Layers of compiled priors.

Only the compiled networks of `models.network.feed_forward` contain them, one for each prior.
"""

import numpy as np
from numpy.typing import NDArray

from models.numerics.compiled import reordered

Float32 = NDArray[np.float32]

PANEL = 256  # columns of a layer at a time: rows of so many stay in the nearest cache


@reordered
def affine_into(rows: Float32, matrix: Float32, bias: Float32, out: Float32) -> None:
    """Write rows (n, m) @ matrix (m, b) + bias (b,) to `out` (n, b), in panels."""
    n, m = rows.shape
    width = matrix.shape[1]
    fours = m - m % 4
    for begin in range(0, width, PANEL):
        end = min(begin + PANEL, width)
        for i in range(n):
            for j in range(begin, end):
                out[i, j] = bias[j]
        for k in range(0, fours, 4):
            d0, d1 = matrix[k, begin:end], matrix[k + 1, begin:end]
            d2, d3 = matrix[k + 2, begin:end], matrix[k + 3, begin:end]
            for i in range(n):
                a, b, c, d = rows[i, k], rows[i, k + 1], rows[i, k + 2], rows[i, k + 3]
                if a == 0 and b == 0 and c == 0 and d == 0:
                    continue  # codes of dictionaries are sparse
                row = out[i, begin:end]
                for j in range(end - begin):
                    row[j] += (a * d0[j] + b * d1[j]) + (c * d2[j] + d * d3[j])
        for k in range(fours, m):
            d0 = matrix[k, begin:end]
            for i in range(n):
                a = rows[i, k]
                row = out[i, begin:end]
                for j in range(end - begin):
                    row[j] += a * d0[j]
