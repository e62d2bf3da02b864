"""Bone lengths: distances within the subject that stay the same while it moves."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.medians import NORMAL, lower_median
from models.numerics.tiny import TINY

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int64 = NDArray[np.int64]

# Figures: evidence/lenses.md.
LEAST_SCATTER = 0.003  # of a log length: keypoints do not sit on bones, so none is held tighter
UNSTEADY = 0.04  # of a log length: a distance that scatters more is no bone
OUTLIER = 2.0  # scatters beyond which a length has less and less weight
LEAST_FRAMES = 5  # in which a bone is measured
UNKNOWN = 1e3  # scatter of a distance that is measured in fewer
ROUNDS = 10  # of estimating the frames' sizes from the bones and choosing these again


class BoneLengths(NamedTuple):
    """E = P - 1 distances that connect all keypoints; the size of every frame is free.

    They need not be anatomical bones: keypoints that move together, such as the hips, count.
    """

    ends: Int64  # (2, E) keypoints
    lengths: Float64  # (E,) log, median
    scatter: Float64  # (E,) of the log lengths, standard deviation
    measured: Bool  # (N, E) whether views measure them in each of N frames, or (1, E) in all frames

    @property
    def steady(self) -> bool:
        """Whether most of them are bones."""
        return bool(lower_median(self.scatter) < UNSTEADY)

    def offsets(self, points: Float64) -> Float64:
        """Return log lengths (N, E) in structures (N, P, 3), less the usual ones and the size."""
        offsets = _log_lengths(points, self.ends) - self.lengths
        return offsets - self.mean(offsets, self.measured)

    def derivatives(self, points: Float64, by: Float64) -> Float64:
        """Return derivatives (N, E, T) of the offsets from those of the points, (N, P, 3, T)."""
        a, b = self.ends
        apart = points[:, a] - points[:, b]  # (N, E, 3)
        along = apart / np.square(apart).sum(-1, keepdims=True).clip(TINY)
        derived = (along[:, :, None] @ (by[:, a] - by[:, b]))[:, :, 0]  # (N, E, T)
        left: Float64 = derived - self.mean(derived.mT, self.measured[:, None]).mT
        return left

    def mean(self, offsets: Float64, measured: Bool) -> Float64:
        """Return means (..., 1) of measured offsets (..., E), by inverse squared scatter."""
        weights = measured / np.square(self.scatter)
        total = weights.sum(-1, keepdims=True)
        mean: Float64 = (offsets * weights).sum(-1, keepdims=True) / np.maximum(total, TINY)
        return mean

    def precision(self, offsets: Float64) -> Float64:
        """Return inverse variances (N, E), less for outliers; 0 for distances that are no bones."""
        steady = self.measured & (self.scatter < UNSTEADY)
        precision: Float64 = steady / (np.square(self.scatter) * (1 + self._squared(offsets)))
        return precision

    def cost(self, points: Float64) -> Float64:
        """Minus twice the log likelihood (N,) of the lengths, up to a constant (Cauchy's)."""
        steady = self.measured & (self.scatter < UNSTEADY)
        cost: Float64 = OUTLIER**2 * (steady * np.log1p(self._squared(self.offsets(points)))).sum(
            -1
        )
        return cost

    def _squared(self, offsets: Float64) -> Float64:
        return np.square(offsets / (OUTLIER * self.scatter))


def find_bone_lengths(points: Float64, measured: Bool | None = None) -> BoneLengths:
    """Find the distances that scatter least in structures (N, P, 3).

    Wrong frames count little, because the scatter is the median absolute deviation. `measured` (N,
    P) are the keypoints seen by two views or more, by default all: a distance to any other keypoint
    comes from a prior, and is no measurement.
    """
    count = points.shape[1]
    pairs = np.stack(np.triu_indices(count, 1))  # (2, P (P - 1) / 2)
    both, enough = np.ones((1, pairs.shape[1]), np.bool_), np.ones(pairs.shape[1], np.bool_)
    if measured is not None:
        both = measured[:, pairs[0]] & measured[:, pairs[1]]  # (N, P (P - 1) / 2)
        enough = both.sum(0) >= LEAST_FRAMES
    lengths = _log_lengths(points, pairs)
    sizes = _median_of_measured(lengths - _median_of_measured(lengths, both, 0), both, 1)  # (N, 1)
    for _ in range(ROUNDS):
        scaled = lengths - sizes
        middle = _median_of_measured(scaled, both, 0)[0]
        deviation = NORMAL * _median_of_measured(np.abs(scaled - middle), both, 0)[0]
        scatter = np.sqrt(np.square(deviation) + LEAST_SCATTER**2)
        scatter = np.where(enough, scatter, UNKNOWN)
        tree = _lightest_tree(scatter, pairs, count)
        bones = BoneLengths(pairs[:, tree], middle[tree], scatter[tree], both[:, tree])
        sizes = bones.mean(lengths[:, tree] - bones.lengths, bones.measured)
    return bones


def _median_of_measured(numbers: Float64, measured: Bool, axis: int) -> Float64:
    """Return the lower medians of the measured numbers, 0 without any; axes are kept."""
    if measured.all():
        return np.asarray(lower_median(numbers, axis, keepdims=True), np.float64)
    rising = np.sort(np.where(measured, numbers, np.inf), axis)
    middle = np.maximum(measured.sum(axis, keepdims=True) - 1, 0) // 2
    medians = np.take_along_axis(rising, middle, axis)
    return np.where(np.isfinite(medians), medians, 0.0)


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
