"""How often the truth lies as near to an answer as the answer's covariance lets expect.

A structure is known up to a similarity. So the truth is moved onto the answer until the errors of
some points, those that align, contain no translation, turn or growth of the answer; and the
covariance is that of errors which were moved so. Ratios of lengths need no alignment.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from models.numerics.rotations import nearest_rotations

Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

RATIOS = 6  # of two lengths, drawn in each frame
ENDS = 4  # points of such a ratio
TINY = 1e-9  # of the largest variance of a point: less counts as none
ROWS, COLUMNS = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])  # xx xy xz yy yz zz


class Held(NamedTuple):
    """The points of a frame, held against the truth; lengths are in the unit of the answer."""

    distances: Float64  # (P,) squared, in standard deviations: chi-squared with 3 degrees
    errors: Float64  # (P,)
    expected: Float64  # (P,) root mean square of the error


def covariance_of(blocks: Float64, modes: Float64) -> Float64:
    """Return the covariance (3P, 3P) of all coordinates of a structure.

    Parameters
    ----------
    blocks, modes
        `points3d_covariance` (P, 6) and `points3d_modes` (P, 3, R) of one frame.
    """
    count = len(blocks)
    common = modes.reshape(3 * count, -1)
    whole = (common @ common.T).reshape(count, 3, count, 3)
    each = np.arange(count)
    for values, i, j in zip(blocks.T, ROWS, COLUMNS, strict=True):
        whole[each, i, each, j] = whole[each, j, each, i] = values
    return whole.reshape(3 * count, 3 * count)


def held(answer: Float64, truth: Float64, covariance: Float64, aligning: Bool) -> Held:
    """Hold an answer (P, 3) with its covariance (3P, 3P) against the truth (P, 3).

    The points `aligning` (P,), three or more, align the truth.
    """
    error = (_moved(truth, answer, aligning) - answer).ravel()
    keeping = _without_similarity(answer, aligning)
    left = (keeping @ covariance @ keeping.T).reshape(len(answer), 3, len(answer), 3)
    each = np.arange(len(answer))
    blocks, errors = left[each, :, each], error.reshape(-1, 3)
    inverses = np.linalg.pinv(blocks, rcond=TINY, hermitian=True)
    return Held(
        np.einsum("pi,pij,pj->p", errors, inverses, errors),
        np.linalg.norm(errors, axis=1),
        np.sqrt(blocks.trace(axis1=1, axis2=2)),
    )


def ratio_scores(
    answer: Float64, truth: Float64, covariance: Float64, rng: np.random.Generator
) -> Float64:
    """Return squared errors of log ratios of two lengths, in their standard deviations: (6,).

    Each ratio is of four points, drawn. Lengths of 0 are left out.
    """
    scores = []
    for _ in range(RATIOS):
        a, b, c, d = rng.choice(len(answer), ENDS, replace=False)
        slopes, error = np.zeros(answer.shape), 0.0
        for start, end, sign in ((a, b, 1.0), (c, d, -1.0)):
            ours, true = answer[end] - answer[start], truth[end] - truth[start]
            length, right = np.linalg.norm(ours), np.linalg.norm(true)
            if not length > 0 or not right > 0:
                error = np.nan
                break
            error += sign * float(np.log(right / length))
            slopes[end] += sign * ours / length**2
            slopes[start] -= sign * ours / length**2
        variance = float(slopes.ravel() @ covariance @ slopes.ravel())
        scores.append(error**2 / variance if variance > 0 else np.nan)
    return np.array(scores)


def shares(scores: Float64, degrees: int, levels: Sequence[float]) -> list[float]:
    """Return how many squared scores lie within what so large a share should; NaN if none are."""
    known = scores[np.isfinite(scores)]
    if not len(known):
        return [float("nan")] * len(levels)
    return [float((known < chi2.ppf(level, degrees)).mean()) for level in levels]


def _moved(truth: Float64, answer: Float64, aligning: Bool) -> Float64:
    """Move the truth so that its differences from the answer contain no similarity of it."""
    middle, ours = truth[aligning].mean(0), answer[aligning].mean(0)
    target = answer[aligning] - ours
    turned = (truth - middle) @ nearest_rotations(target.T @ (truth[aligning] - middle)).T
    moved: Float64 = turned * np.square(target).sum() / np.sum(target * turned[aligning]) + ours
    return moved


def _without_similarity(answer: Float64, aligning: Bool) -> Float64:
    """Return what takes errors (3P,) to those after the alignment: (3P, 3P)."""
    centred = answer - answer[aligning].mean(0)
    turns = np.cross(np.eye(3)[:, None], centred).transpose(1, 2, 0)  # (P, 3, 3)
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    ways = np.concatenate((shifts, turns, centred[..., None]), -1)  # (P, 3, 7)
    which = np.repeat(aligning, 3)
    every = ways.reshape(-1, 7)
    result = np.eye(len(every))
    result[:, which] -= every @ np.linalg.pinv(every[which])
    return result
