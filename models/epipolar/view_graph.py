"""The points that views share, and the relative poses of pairs that connect the views."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.assembly import ViewGraph
from models.epipolar.fundamental import common_offsets, sampson_distances
from models.epipolar.pairs import Beliefs, relate
from models.epipolar.static_cameras import SeenPoints
from models.numerics.steps import Steps

Float64 = NDArray[np.float64]

MOST_POINTS = 3000  # of a pair of views that are related
NOISY_POINTS = 9000  # of a sample
MOST_PAIRS = 18  # of views that are related
UNLIKE_PAIRS = 5.0  # times the noise of the best pair: a pair beyond it is not static
LENS_NOISE = 1e-3  # sides: what lens models leave at most
NO_RIG = 0.3  # noise, as a share of a view's size, from which cameras are not static
# Nor are two cameras with this noise if frames have so much of it in common: of drawn captures 0 to
# 129 no static pair had more than 1.7 in common with half of this noise.
MOVING, IN_COMMON = 0.1, 5.0


class SharedPoints(NamedTuple):
    """All (frame, keypoint) that two views or more see, as points, and a sample of them."""

    frames: NDArray[np.int64]  # (M,)
    keypoints: NDArray[np.int64]  # (M,)
    images: Float64  # (K, 2, M)
    weights: Float64  # (K, M)
    sample: NDArray[np.int64]  # places of at most `NOISY_POINTS` of them, in no order

    @classmethod
    def of(cls, images: Float64, weights: Float64, rng: np.random.Generator) -> "SharedPoints":
        """Take images (N, K, P, 2) with weights (N, K, P)."""
        frames, keypoints = np.nonzero((weights > 0).sum(1) >= 2)
        order = rng.permutation(len(frames))
        # Points that many views see come first: they connect the views.
        seen = (weights > 0).sum(1)[frames, keypoints][order]
        order = order[np.argsort(-np.minimum(seen, 3), kind="stable")]
        return cls(
            frames,
            keypoints,
            images[frames, :, keypoints].transpose(1, 2, 0),
            weights[frames, :, keypoints].T,
            order[:NOISY_POINTS],
        )

    def seen(self, members: list[int], most: int) -> SeenPoints:
        """Return the images of at most so many points of the sample in some views."""
        points = self.chosen(members, most)
        return SeenPoints(self.images[members][..., points], self.weights[members][:, points])

    def chosen(self, members: list[int], most: int) -> NDArray[np.int64]:
        """Return the places of these points."""
        several = np.flatnonzero((self.weights[members][:, self.sample] > 0).sum(0) >= 2)
        return self.sample[several[:most]]


def relate_pairs(
    scene: SharedPoints, beliefs: Beliefs, rng: np.random.Generator
) -> Steps[ViewGraph]:
    """Find the relative poses of pairs; of many views those that share most, connecting all."""
    views = len(scene.weights)
    there = (scene.weights > 0).astype(float)
    shared = there @ there.T
    pairs = sorted(combinations(range(views), 2), key=lambda pair: -shared[pair])
    graph: ViewGraph = {}
    for pair in _chosen_pairs(pairs, views):
        yield
        first, second = pair
        both = np.flatnonzero((there[first] > 0) & (there[second] > 0))
        some = rng.permutation(both)[:MOST_POINTS]
        lenses = list(pair)
        poses = relate(
            scene.images[first][:, some].T,
            scene.images[second][:, some].T,
            beliefs.focals[lenses],
            beliefs.focal_sds[lenses],
            rng,
        )
        if poses is not None:
            graph[pair] = poses
    return graph


def _chosen_pairs(pairs: list[tuple[int, int]], views: int) -> Iterator[tuple[int, int]]:
    """Take the first pairs, such that every view has its share of them."""
    if len(pairs) <= MOST_PAIRS:
        yield from pairs
        return
    most = max(3, 2 * MOST_PAIRS // views)
    count = [0] * views
    for a, b in pairs:
        if (count[a] < most and count[b] < most) or min(count[a], count[b]) == 0:
            count[a], count[b] = count[a] + 1, count[b] + 1
            yield a, b


def moving_pairs(scene: SharedPoints, graph: ViewGraph, sizes: Float64) -> set[tuple[int, int]]:
    """Return the pairs that cannot be static: whole frames are far off, not single keypoints.

    `sizes` (K,) are those of the subject, in sides.
    """
    found = set()
    for pair, poses in graph.items():
        if poses.noise < MOVING * sizes[list(pair)].mean():
            continue
        both = np.flatnonzero((scene.weights[list(pair)] > 0).all(0))
        x, y = (scene.images[view][:, both].T for view in pair)
        distances = sampson_distances(poses.fundamental, x, y) / poses.noise
        if common_offsets(distances, scene.frames[both]) > IN_COMMON:
            found.add(pair)
    return found


def tied_views(graph: ViewGraph, sizes: Float64) -> list[int]:
    """Return the views connected by pairs whose noise is that of static views."""
    least = min((poses.noise for poses in graph.values()), default=0.0)
    most = UNLIKE_PAIRS * max(least, LENS_NOISE)
    likely = [
        pair
        for pair, poses in graph.items()
        if poses.noise < min(most, NO_RIG * float(sizes[list(pair)].mean()))
    ]
    label = list(range(len(sizes)))
    for j, k in likely:
        old, new = label[k], label[j]
        label = [new if x == old else x for x in label]
    largest = max(set(label), key=label.count)
    return [k for k in range(len(sizes)) if label[k] == largest]
