"""Segments: distances within the subject that stay the same while it moves, such as bones."""

from typing import NamedTuple

import torch
from torch import Tensor

SOFT = 0.003  # of a length: keypoints do not sit on bones, so no segment is held to be steadier
UNSTEADY = 0.04  # what scatters more is no segment
OUTLIER = 2.0  # scatters beyond which a length pulls ever less
ROUNDS = 10  # of taking the frames' sizes from the segments and choosing these anew


class Segments(NamedTuple):
    """P - 1 distances that connect all keypoints, the size of every frame being free."""

    ends: Tensor  # (2, E) keypoints
    lengths: Tensor  # (E,) log, median
    scatter: Tensor  # (E,) of the log lengths, standard deviation

    @property
    def steady(self) -> bool:
        """Whether most of them deserve the name."""
        return bool(self.scatter.median() < UNSTEADY)

    def offsets(self, points: Tensor) -> Tensor:
        """Log lengths (N, E) in structures (N, P, 3), less the usual ones and the frame's size."""
        offsets = _log_lengths(points, self.ends) - self.lengths
        return offsets - self._mean(offsets)

    def derivatives(self, points: Tensor, by: Tensor) -> Tensor:
        """Derive the offsets: (N, E, T), from how the points move, (N, P, 3, T)."""
        a, b = self.ends
        apart = points[:, a] - points[:, b]  # (N, E, 3)
        along = apart / apart.square().sum(-1, keepdim=True).clamp_min(1e-12)
        derived = torch.einsum("nei,neit->net", along, by[:, a] - by[:, b])
        return derived - self._mean(derived.mT).mT

    def _mean(self, offsets: Tensor) -> Tensor:
        weights = self.scatter.square().reciprocal()
        mean: Tensor = (offsets * weights).sum(-1, keepdim=True) / weights.sum()
        return mean

    def precision(self, offsets: Tensor) -> Tensor:
        """Inverse variances (N, E), less for outliers; 0 for what is no segment."""
        squared = (offsets / (OUTLIER * self.scatter)).square()
        steady = self.scatter < UNSTEADY
        return steady / (self.scatter.square() * (1 + squared))

    def cost(self, points: Tensor) -> Tensor:
        """Minus twice the log likelihood (N,) of the lengths, up to a constant (Cauchy's)."""
        squared = (self.offsets(points) / (OUTLIER * self.scatter)).square()
        steady = self.scatter < UNSTEADY
        return OUTLIER**2 * (steady * squared.log1p()).sum(-1)


def find_segments(points: Tensor) -> Segments:
    """Find the distances that scatter least in structures (N, P, 3).

    Frames that lie askew count little: the scatter is the median absolute deviation.
    """
    count = points.shape[1]
    pairs = torch.triu_indices(count, count, 1)
    lengths = _log_lengths(points, pairs)
    sizes = (lengths - lengths.median(0).values).median(1, keepdim=True).values  # (N, 1)
    for _ in range(ROUNDS):
        scaled = lengths - sizes
        middle = scaled.median(0).values
        scatter = (1.4826 * (scaled - middle).abs().median(0).values).square().add(SOFT**2).sqrt()
        tree = _lightest_tree(scatter, pairs, count)
        found = Segments(pairs[:, tree], middle[tree], scatter[tree])
        sizes = found._mean(lengths[:, tree] - found.lengths)
    return found


def _log_lengths(points: Tensor, pairs: Tensor) -> Tensor:
    apart = points[:, pairs[0]] - points[:, pairs[1]]
    logarithms: Tensor = apart.norm(dim=-1).clamp_min(1e-12).log()
    return logarithms


def _lightest_tree(weights: Tensor, pairs: Tensor, count: int) -> Tensor:
    """Edges of the minimum spanning tree (Kruskal's algorithm)."""
    label, tree = list(range(count)), []
    ends = pairs.T.tolist()
    for edge in weights.argsort().tolist():
        new, old = (label[end] for end in ends[edge])
        if old != new:
            label = [new if x == old else x for x in label]
            tree.append(edge)
    return torch.tensor(tree)
