"""Poses of a subject: which are far from all others, and which images look alike."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.numerics.medians import NORMAL

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

PAIRS = 200  # of keypoints, whose distances describe a pose
REFERENCES = 500  # moments, spread over all, that poses are compared with
FAR = 8.0  # robust deviations of the distance to the nearest pose
LEAST_RATIO = 2.0  # times the usual distance to the nearest pose
LEAST_DISTANCE = 0.05  # of the subject's size
FEWEST = 20  # moments with a structure, of which some can be unlike the others
ALIKE = 0.15  # of the subject's radius in the image, root mean square
SEED = 0


class PoseDistances(NamedTuple):
    """How far N poses are from the nearest other one, in usual distances; and which are far."""

    ratios: Float64  # (N,), NaN without a structure
    unlike: Bool  # (N,)


def pose_distances(structures: Float64, apart: int) -> PoseDistances:
    """Compare structures (N, P, 3) with others that are `apart` frames away or more.

    A pose is described by distances between pairs of keypoints, over the usual size of the subject:
    wherever it stands and turns, it is the same.
    """
    poses = _descriptions(structures)
    known = np.flatnonzero(np.isfinite(poses).all(1))
    ratios = np.full(len(poses), np.nan)
    unlike = np.zeros(len(poses), np.bool_)
    if len(known) < FEWEST:
        return PoseDistances(ratios, unlike)
    step = -(-len(known) // REFERENCES)
    chosen = known[::step]
    nearest = np.full(len(poses), np.nan)
    squares = np.square(poses[chosen]).sum(1)
    for some in np.array_split(known, -(-len(known) // REFERENCES)):
        to_chosen = np.square(poses[some]).sum(1)[:, None] + squares
        to_chosen -= 2 * poses[some] @ poses[chosen].T
        to_chosen[np.abs(some[:, None] - chosen) < apart] = np.inf
        nearest[some] = np.sqrt(np.maximum(to_chosen.min(1), 0))
    finite = nearest[np.isfinite(nearest)]
    if len(finite) < FEWEST or not (usual := float(np.median(finite))):
        return PoseDistances(ratios, unlike)
    spread = NORMAL * float(np.median(np.abs(finite - usual)))
    ratios = np.where(np.isfinite(nearest), nearest / usual, np.nan)
    with np.errstate(invalid="ignore"):
        unlike = (ratios > LEAST_RATIO) & (nearest > usual + FAR * spread)
        unlike &= nearest > LEAST_DISTANCE
    return PoseDistances(ratios, unlike)


def _descriptions(structures: Float64) -> Float64:
    """Return distances (N, D) between some keypoints; NaN for moments without a structure."""
    there = np.asarray(np.isfinite(structures).all(-1))  # (N, P)
    lifted = there.any(1)
    points = np.flatnonzero(there[lifted].all(0)) if lifted.any() else np.empty(0, np.int64)
    first, second = (points[index] for index in np.triu_indices(len(points), 1))
    if len(first) > PAIRS:
        some = np.random.default_rng(SEED).choice(len(first), PAIRS, replace=False)
        first, second = first[some], second[some]
    apart = np.linalg.norm(structures[:, first] - structures[:, second], axis=-1)
    if not apart.size:
        return np.full((len(structures), 1), np.nan)
    size = np.sqrt(np.square(apart[lifted]).mean()) * np.sqrt(apart.shape[1])
    return np.asarray(apart / max(float(size), 1e-300))


def image_shapes(pixels: Float64) -> Float64:
    """Return how a subject looks in images: pixels (N, K, P, 2), centred and of unit radius."""
    there = np.isfinite(pixels).all(-1, keepdims=True)
    count = np.maximum(there.sum(-2, keepdims=True), 1)
    centred = pixels - np.where(there, pixels, 0).sum(-2, keepdims=True) / count
    squares = np.where(there, np.square(centred).sum(-1, keepdims=True), 0)
    radii = np.sqrt(squares.sum(-2, keepdims=True) / count)
    return np.where(there & (radii > 0), centred / np.maximum(radii, 1e-300), np.nan)


def are_alike(shapes: Float64, shape: Float64) -> Bool:
    """Return which of shapes (M, P, 2) look like one (P, 2), by the keypoints that both have."""
    squares = np.square(shapes - shape).sum(-1)
    both = np.isfinite(squares)
    mean = np.where(both, squares, 0).sum(-1) / np.maximum(both.sum(-1), 1)
    return np.asarray(both.any(-1) & (mean < ALIKE**2))
