"""Pairs of static views: their fundamental matrices, and the cost of each frame under them.

A capture is checked for faults by comparing the costs of its frames under hypotheses: as they are,
with two views exchanged, and so on. Costs are negative log likelihoods under Student's t of the
Sampson distances, so differences between them are log likelihood ratios.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.epipolar.fundamental import (
    FREEDOM,
    LEAST_POINTS,
    Fundamental,
    common_offsets,
    fit_fundamental,
    sampson_distances,
)

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Pairs = tuple[tuple[int, int], ...]
Matrices = dict[tuple[int, int], Fundamental]

MOST_ANCHORS = 3  # views that are paired with every view: the cost grows with views, not squared
FIT_POINTS = 1500  # correspondences to which a fundamental matrix is fitted
MOST_KEYPOINTS = 32  # that are used
LENS_ERROR = 5e-3  # of a view's radius: error of straight lines under lens distortion
ASTRAY = 0.1  # of keypoints that may lie anywhere
# For static views, the mean offset of a frame varies by no more than this over what noise explains,
# unless all is so little (of a view's radius) that lenses explain it.
MOST_COMMON, LITTLE_NOISE = 2.5, 0.05
AGREEING = 0.6  # of the pairs: a view that moves does not hide that others are static
TINY = 1e-9
DEPENDENCE = 0.5  # of a log likelihood ratio that counts: pairs of views share their noise
MOST_NOISE = 0.25  # of a view's radius: beyond it, no one geometry explains the frames


class SeenFrames(NamedTuple):
    """The keypoints of N frames of K views, in the order of the frames."""

    pixels: Float64  # (N, K, P, 2), 0 where not seen
    there: Bool  # (N, K, P)
    keypoints: NDArray[np.intp]  # (P,) which of the capture's keypoints these are
    radius: float  # pixels, root mean square of a view's keypoints about their middle, the median

    def part(self, frames: NDArray[np.intp] | Bool | slice) -> "SeenFrames":
        """Return some of the frames."""
        return self._replace(pixels=self.pixels[frames], there=self.there[frames])

    def thinned(self, most: int) -> "SeenFrames":
        """Return `most` of the keypoints at most."""
        every = slice(None, None, -(-self.there.shape[2] // most))
        return self._replace(
            pixels=self.pixels[:, :, every],
            there=self.there[:, :, every],
            keypoints=self.keypoints[every],
        )

    def reordered(self, order: NDArray[np.intp]) -> "SeenFrames":
        """Return the frames with the views that `order` (N, K) names for each."""
        rows = np.arange(len(order))[:, None]
        return self._replace(pixels=self.pixels[rows, order], there=self.there[rows, order])

    @property
    def floor(self) -> float:
        """Noise in pixels below which differences are due to lenses rather than frames."""
        return LENS_ERROR * self.radius


def seen_keypoints(keypoints: NDArray[np.floating], weights: NDArray[np.floating]) -> SeenFrames:
    """Return keypoints (N, K, P, 2) in pixels of positive weight (N, K, P), the most seen ones."""
    there = (weights > 0) & np.isfinite(keypoints).all(-1)
    most = np.sort(np.argsort(-there.sum((0, 1)), kind="stable")[:MOST_KEYPOINTS])
    there = there[:, :, most]
    pixels = np.where(there[..., None], keypoints[:, :, most], 0.0).astype(np.float64)
    return SeenFrames(pixels, there, most, _radius(pixels, there))


def _radius(pixels: Float64, there: Bool) -> float:
    """Median over frames and views of the root-mean-square radius of a view, in pixels."""
    enough = there.sum(-1) > 2
    if not enough.any():
        return 1.0
    shown, weights = pixels[enough], there[enough][..., None]  # (M, P, 2), (M, P, 1)
    counts = weights.sum(1, keepdims=True)
    offsets = (shown - shown.sum(1, keepdims=True) / counts) * weights
    squares = np.square(offsets).sum((1, 2)) / counts[:, 0, 0]
    return max(float(np.sqrt(np.median(squares))), TINY)


def chosen_pairs(seen: SeenFrames) -> Pairs:
    """Pairs (a < b) of which one is among the views that show most: all pairs, up to four views."""
    shown = seen.there.sum((0, 2))  # (K,)
    anchors = set(np.argsort(-shown, kind="stable")[:MOST_ANCHORS].tolist())
    pairs = combinations(range(len(shown)), 2)
    return tuple((a, b) for a, b in pairs if a in anchors or b in anchors)


def fit_pairs(seen: SeenFrames, pairs: Pairs, start: Matrices | None = None) -> Matrices:
    """Fit a fundamental matrix to every pair that has enough correspondences."""
    known = start or {}
    fitted = {(a, b): fit_pair(seen, a, b, known.get((a, b))) for a, b in pairs}
    return {pair: found for pair, found in fitted.items() if found is not None}


def fit_pair(
    seen: SeenFrames, a: int, b: int, start: Fundamental | None = None
) -> Fundamental | None:
    """Fit y^T F x = 0 to views a (x) and b (y); None if too few keypoints are seen by both."""
    both = np.flatnonzero(seen.there[:, a] & seen.there[:, b])
    if len(both) < 2 * LEAST_POINTS:
        return None
    # A step of the golden ratio: spread over frames and keypoints alike, and not at random.
    if len(both) > FIT_POINTS:
        chosen = (np.arange(FIT_POINTS) * 0.6180339887498949) % 1 * len(both)
        both = both[np.sort(chosen.astype(np.intp))]
    x = seen.pixels[:, a].reshape(-1, 2)[both]
    y = seen.pixels[:, b].reshape(-1, 2)[both]
    return fit_fundamental(x, y, floor=seen.floor, start=None if start is None else start.matrix)


def between(matrices: Matrices, a: int, b: int) -> Fundamental | None:
    """Return F with y^T F x = 0 for x of view a and y of view b, whichever way it was fitted."""
    if (a, b) in matrices:
        return matrices[a, b]
    found = matrices.get((b, a))
    return None if found is None else Fundamental(found.matrix.T, found.scale)


def point_costs(found: Fundamental, x: Float64, y: Float64, both: Bool, radius: float) -> Float64:
    """Negative log likelihood of correspondences x, y (..., 2); 0 unless `both` (...) are seen.

    The distribution is a mixture of Student's t and of a share `ASTRAY` of keypoints that lie
    anywhere. The negative log likelihood under noise of `MOST_NOISE` of the radius is subtracted,
    so that a correspondence that fits no better than chance counts as 0.
    """
    distances = sampson_distances(found.matrix, x.reshape(-1, 2), y.reshape(-1, 2))
    tails = np.square(1 + np.square(distances / found.scale) / FREEDOM)  # (FREEDOM + 1) / 2 = 2
    costs = -np.log((1 - ASTRAY) * (MOST_NOISE * radius / found.scale) / tails + ASTRAY)
    counted: Float64 = np.where(both, costs.reshape(both.shape), 0.0)
    return counted


def frame_costs(seen: SeenFrames, found: Fundamental, a: int, b: int) -> Float64:
    """Cost of each frame (N,) when view a is seen by F's first camera and view b by its second."""
    both = seen.there[:, a] & seen.there[:, b]
    costs = point_costs(found, seen.pixels[:, a], seen.pixels[:, b], both, seen.radius)
    summed: Float64 = costs.sum(1)
    return summed


def total_cost(seen: SeenFrames, matrices: Matrices) -> float:
    """Cost of all frames and pairs together."""
    return sum(float(frame_costs(seen, found, *pair).sum()) for pair, found in matrices.items())


def are_static(seen: SeenFrames, matrices: Matrices) -> bool:
    """Whether one geometry per pair explains the frames, as for static cameras.

    If cameras move, a frame has a geometry of its own, and the keypoints in it have a common offset
    from the epipolar lines. For static cameras these offsets are independent noise.
    """
    noises, common = [], []
    for (a, b), found in matrices.items():
        both = seen.there[:, a] & seen.there[:, b]
        x, y = seen.pixels[:, a].reshape(-1, 2), seen.pixels[:, b].reshape(-1, 2)
        offsets = sampson_distances(found.matrix, x, y)[both.ravel()] / found.scale
        ratio = common_offsets(offsets, np.nonzero(both)[0])
        if np.isfinite(ratio):
            common.append(ratio)
            noises.append(found.scale / seen.radius)
    if not noises or np.median(noises) > MOST_NOISE:
        return False
    agree = (np.array(common) < MOST_COMMON) | (np.array(noises) < LITTLE_NOISE)
    return bool(agree.mean() > AGREEING)
