"""Bone lengths: distances within the subject that stay the same while it moves."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.medians import lower_median

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

LEAST_SCATTER = 0.003  # of a log length: keypoints do not sit on bones, so none is held steadier
UNSTEADY = 0.04  # of a log length: what scatters more is no bone
OUTLIER = 2.0  # scatters beyond which a length pulls ever less
ROUNDS = 10  # of taking the frames' sizes from the bones and choosing these anew
NORMAL = 1.4826  # standard deviations in a median absolute deviation
TINY = 1e-12


class BoneLengths(NamedTuple):
    """E = P - 1 distances that connect all keypoints, the size of every frame being free.

    They need not be anatomical bones: what moves as one, such as the hips, counts.
    """

    ends: Int64  # (2, E) keypoints
    lengths: Float64  # (E,) log, median
    scatter: Float64  # (E,) of the log lengths, standard deviation

    @property
    def steady(self) -> bool:
        """Whether most of them are bones."""
        return bool(lower_median(self.scatter) < UNSTEADY)

    def offsets(self, points: Float64) -> Float64:
        """Log lengths (N, E) in structures (N, P, 3), less the usual ones and the frame's size."""
        offsets = _log_lengths(points, self.ends) - self.lengths
        return offsets - self.mean(offsets)

    def derivatives(self, points: Float64, by: Float64) -> Float64:
        """Derive the offsets: (N, E, T), from how the points move, (N, P, 3, T)."""
        a, b = self.ends
        apart = points[:, a] - points[:, b]  # (N, E, 3)
        along = apart / np.square(apart).sum(-1, keepdims=True).clip(TINY)
        derived = (along[:, :, None] @ (by[:, a] - by[:, b]))[:, :, 0]  # (N, E, T)
        left: Float64 = derived - self.mean(derived.mT).mT
        return left

    def mean(self, offsets: Float64) -> Float64:
        """Mean (..., 1) of offsets (..., E), each as surely as it is steady."""
        weights = 1 / np.square(self.scatter)
        mean: Float64 = (offsets * weights).sum(-1, keepdims=True) / weights.sum()
        return mean

    def precision(self, offsets: Float64) -> Float64:
        """Inverse variances (N, E), less for outliers; 0 for what is no bone."""
        steady = self.scatter < UNSTEADY
        precision: Float64 = steady / (np.square(self.scatter) * (1 + self._squared(offsets)))
        return precision

    def cost(self, points: Float64) -> Float64:
        """Minus twice the log likelihood (N,) of the lengths, up to a constant (Cauchy's)."""
        steady = self.scatter < UNSTEADY
        cost: Float64 = OUTLIER**2 * (steady * np.log1p(self._squared(self.offsets(points)))).sum(
            -1
        )
        return cost

    def _squared(self, offsets: Float64) -> Float64:
        return np.square(offsets / (OUTLIER * self.scatter))


def find_bone_lengths(points: Float64) -> BoneLengths:
    """Find the distances that scatter least in structures (N, P, 3).

    Frames that lie askew count little: the scatter is the median absolute deviation.
    """
    count = points.shape[1]
    pairs = np.stack(np.triu_indices(count, 1))  # (2, P (P - 1) / 2)
    lengths = _log_lengths(points, pairs)
    sizes = lower_median(lengths - lower_median(lengths, 0), 1, keepdims=True)  # (N, 1)
    for _ in range(ROUNDS):
        scaled = lengths - sizes
        middle = lower_median(scaled, 0)
        deviation = NORMAL * lower_median(np.abs(scaled - middle), 0)
        scatter = np.sqrt(np.square(deviation) + LEAST_SCATTER**2)
        tree = _lightest_tree(scatter, pairs, count)
        bones = BoneLengths(pairs[:, tree], middle[tree], scatter[tree])
        sizes = bones.mean(lengths[:, tree] - bones.lengths)
    return bones


def _log_lengths(points: Float64, pairs: Int64) -> Float64:
    apart = points[:, pairs[0]] - points[:, pairs[1]]
    lengths: Float64 = np.log(np.linalg.norm(apart, axis=-1).clip(TINY))
    return lengths


def _lightest_tree(weights: Float64, pairs: Int64, count: int) -> Int64:
    """Edges of the minimum spanning tree (Kruskal's algorithm)."""
    label, tree = list(range(count)), []
    ends = pairs.T.tolist()
    for edge in np.argsort(weights, kind="stable").tolist():
        new, old = (label[end] for end in ends[edge])
        if old != new:
            label = [new if x == old else x for x in label]
            tree.append(edge)
    return np.array(tree)
