"""Offsets in time to a fraction of a frame, with standard errors: Gauss-Newton with all pairs.

The Sampson distance of a pair depends on its fundamental matrix and on the times at which the two
views are read. Its derivative by the time is how far the keypoint moves across its epipolar line.
So offsets and matrices are estimated together by least squares with Student's weights. The matrices
of rank two (seven unknowns on a manifold) are eliminated pair by pair, which leaves one small
system for the offsets of all views. Offsets are sums of given functions of time, such as a constant
and a drift.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.tracks import Motion, Track, motion_at
from models.epipolar.fundamental import (
    LEAST_POINTS,
    fit_fundamental,
    robust_costs,
    robust_scale,
    sampson_distances,
    student_weights,
)

Float64 = NDArray[np.float64]
Int = NDArray[np.int64]
Pair = tuple[int, int]

POINTS = 9000  # of a pair
ROUNDS = 8
MATRIX_ROUNDS = 2  # steps of a pair's matrix in each round
CONVERGED = 0.003  # frames
LARGEST_STEP = 1.5  # frames: beyond it, motion is not linear any more
# Standard errors come from the scatter between blocks of frames: at most so many. A block is longer
# than the correlation of errors of smoothed keypoints (in half widths) and detectors (in frames).
MOST_BLOCKS, BLOCK_WIDTHS, BLOCK_FRAMES = 16, 1.5, 8
FEWEST_BLOCKS = 4  # with three, Student's t has no variance
FLOOR = 2e-4  # of the extent of the keypoints: finer than any detector or lens model
RIDGE = 1e-9  # of the information: views without any pair keep their offsets


class TrackedFrames(NamedTuple):
    """The frames that are used: keypoints as functions of time, in units of their extent."""

    tracks: list[Track]  # K
    frames: Int  # (T,) consecutive in windows
    pairs: list[Pair]
    half_width: float  # frames, of the smoothing

    @property
    def blocks(self) -> int:
        """How many blocks of frames are independent of each other."""
        return count_blocks(len(self.frames), self.half_width)

    @property
    def radius(self) -> float:
        """Median root-mean-square radius of the subject in a view."""
        spreads = []
        for track in self.tracks:
            weights = track.weights[self.frames, :, None]
            total = np.maximum(weights.sum(1), RIDGE)
            pixels = track.pixels[self.frames]
            mean = (weights * pixels).sum(1) / total
            squares = np.square(pixels - mean[:, None]).sum(-1, keepdims=True)
            spreads.append(np.median(np.sqrt((weights * squares).sum(1) / total)))
        return float(np.median(spreads))


def count_blocks(frames: int, half_width: float) -> int:
    """How many blocks of so many frames are independent of each other after smoothing."""
    return min(int(frames // max(BLOCK_WIDTHS * half_width, BLOCK_FRAMES)), MOST_BLOCKS)


class Refined(NamedTuple):
    """Offsets of K views as M coefficients of functions of time, relative to one of them."""

    coefficients: Float64  # (K, M) frames
    covariances: Float64  # (K, M, M) of a view's coefficients
    noise: float  # of the smoothed keypoints, in units of their extent
    cost: float  # mean logarithm of the noise of the pairs
    matrices: dict[Pair, Float64]
    block_offsets: Float64  # (B, K) frames, that every block of frames would add to a constant
    block_weights: Float64  # (B, K) information on these


class _Equations(NamedTuple):
    """The equations of a pair for the offset of its second view, with its matrix eliminated."""

    information: Float64  # (B, M, M)
    scores: Float64  # (B, M)
    matrix: Float64  # (3, 3)
    scale: float


def refine_offsets(
    tracked: TrackedFrames, start: Float64, functions: Float64, reference: int
) -> Refined | None:
    """Refine the coefficients `start` (K, M) of `functions` (T, M) of the tracked frames.

    The view `reference` keeps its own. None if too few keypoints are seen by two views,
    or there are too few frames for standard errors of the offsets.
    """
    if tracked.blocks < FEWEST_BLOCKS:
        return None
    views, size = start.shape
    coefficients = start.copy()
    thin = slice(None, None, 1 + functions.shape[0] * len(tracked.tracks[0].pixels[0]) // POINTS)
    frames, functions = tracked.frames[thin], functions[thin]
    blocks = np.arange(len(frames)) * tracked.blocks // len(frames)
    free = np.repeat(np.arange(views) != reference, size)
    matrices: dict[Pair, Float64] = {}
    for _ in range(ROUNDS):
        motions = [
            motion_at(track, frames + late, tracked.half_width)
            for track, late in zip(tracked.tracks, coefficients @ functions.T, strict=True)
        ]
        of_pairs = {
            pair: equations
            for pair in tracked.pairs
            if (equations := _equations(motions, pair, functions, blocks, matrices.get(pair)))
        }
        if not of_pairs:
            return None
        matrices = {pair: equations.matrix for pair, equations in of_pairs.items()}
        information, scores = _summed(of_pairs, views)
        flat = information.sum(0).reshape(views * size, views * size)[np.ix_(free, free)]
        inverse = np.linalg.inv(flat + RIDGE * np.trace(flat) * np.eye(len(flat)))
        by_block = scores.reshape(len(scores), -1)[:, free]
        step = np.zeros(views * size)
        step[free] = np.clip(inverse @ by_block.sum(0), -LARGEST_STEP, LARGEST_STEP)
        coefficients += step.reshape(views, size)
        if np.abs(step).max() < CONVERGED:
            break
    covariance = np.zeros((views * size, views * size))
    covariance[np.ix_(free, free)] = inverse @ (by_block.T @ by_block) @ inverse
    # Few blocks: the variance of Student's t with one degree of freedom less than blocks.
    covariance *= len(scores) / (len(scores) - 3)
    return Refined(
        coefficients,
        covariance.reshape(views, size, views, size)[range(views), :, range(views)],
        float(np.median([equations.scale for equations in of_pairs.values()])),
        float(np.mean([np.log(equations.scale) for equations in of_pairs.values()])),
        matrices,
        _of_blocks(np.einsum("bkmlo->bkl", information), scores.sum(-1), reference),
        np.einsum("bkmko->bk", information),
    )


def _summed(of_pairs: dict[Pair, _Equations], views: int) -> tuple[Float64, Float64]:
    """Return information (B, K, M, K, M) and scores (B, K, M) of all views, from those of pairs."""
    blocks, size = next(iter(of_pairs.values())).scores.shape
    information = np.zeros((blocks, views, size, views, size))
    scores = np.zeros((blocks, views, size))
    for (first, second), equations in of_pairs.items():
        for a in (first, second):
            for b in (first, second):
                information[:, a, :, b] += (1 if a == b else -1) * equations.information
        scores[:, second] += equations.scores
        scores[:, first] -= equations.scores
    return information, scores


def costs_of_frames(
    tracked: TrackedFrames, matrices: dict[Pair, Float64], offsets: Float64
) -> Float64:
    """Mean robust cost (T,) of every frame with the views at constant `offsets` (K,)."""
    motions = [
        motion_at(track, tracked.frames + late, tracked.half_width)
        for track, late in zip(tracked.tracks, offsets, strict=True)
    ]
    total = np.zeros(len(tracked.frames))
    for (first, second), matrix in matrices.items():
        x, y = motions[first].places, motions[second].places
        distances = sampson_distances(matrix, x, y)
        known = np.isfinite(distances)
        scale = max(robust_scale(distances[known]), FLOOR) if known.any() else 1.0
        costs = np.where(known, robust_costs(np.where(known, distances, 0), scale), 0)
        total += costs.sum(1) / np.maximum(known.sum(1), 1)
    return total


def _of_blocks(information: Float64, scores: Float64, reference: int) -> Float64:
    """Solve for the offsets (B, K) of each block separately, relative to most of the views."""
    blocks, views = scores.shape
    free = np.flatnonzero(np.arange(views) != reference)
    found = np.zeros((blocks, views))
    for block in range(blocks):
        own = information[block][np.ix_(free, free)]
        own = own + max(RIDGE * float(np.trace(information.sum(0))), RIDGE) * np.eye(len(free))
        found[block, free] = np.linalg.solve(own, scores[block, free])
    if views > 2:
        found -= np.median(found, axis=1, keepdims=True)
    return found


def _equations(
    motions: list[Motion], pair: Pair, functions: Float64, blocks: Int, matrix: Float64 | None
) -> _Equations | None:
    """Take steps of a pair's matrix, then return the equations of its offset."""
    first, second = (motions[view] for view in pair)
    both = np.isfinite(first.places).all(-1) & np.isfinite(second.places).all(-1)  # (T, P)
    if both.sum() < 3 * LEAST_POINTS:
        return None
    frames = np.nonzero(both)[0]
    x, y = first.places[both], second.places[both]
    if matrix is None:
        matrix = fit_fundamental(x, y, floor=FLOOR).matrix
    for step in range(MATRIX_ROUNDS + 1):
        across_y, across_x, distances, by_matrix = _linearise(matrix, x, y)
        if not np.isfinite(distances).all():  # keypoints in an epipole have no epipolar line
            return None
        scale = max(robust_scale(distances), FLOOR)
        weights = student_weights(distances, scale) / scale**2
        weighted = weights[:, None] * by_matrix
        normal = by_matrix.T @ weighted
        normal += RIDGE * np.trace(normal) * np.eye(len(normal))
        if step < MATRIX_ROUNDS:
            change = np.linalg.solve(normal, weighted.T @ distances)
            matrix = _of_rank_two(matrix - (_tangents(matrix) @ change).reshape(3, 3))
    # Reading the second view later changes a distance as reading the first one earlier does.
    by_time = (across_y * second.velocities[both]).sum(1) - (across_x * first.velocities[both]).sum(
        1
    )
    columns = by_time[:, None] / 2 * functions[frames]  # (M', M)
    columns = columns - by_matrix @ np.linalg.solve(normal, weighted.T @ columns)
    count, size = int(blocks[-1]) + 1, functions.shape[1]
    information, scores = np.zeros((count, size, size)), np.zeros((count, size))
    of_block = blocks[frames]
    for block in range(count):
        part = slice(*np.searchsorted(of_block, [block, block + 1]))
        information[block] = columns[part].T @ (weights[part, None] * columns[part])
        scores[block] = -columns[part].T @ (weights[part] * distances[part])
    return _Equations(information, scores, matrix, scale)


def _linearise(
    matrix: Float64, x: Float64, y: Float64
) -> tuple[Float64, Float64, Float64, Float64]:
    """Return epipolar normals of y and x (M, 2), Sampson distances (M,), derivatives (M, 7).

    Normals are those of epipolar lines, over Sampson's denominator; derivatives are by `_tangents`.
    NaN where both keypoints lie in the epipoles.
    """
    one = np.ones((len(x), 1))
    hx, hy = np.concatenate((x, one), 1), np.concatenate((y, one), 1)
    lines_y, lines_x = hx @ matrix.T, hy @ matrix
    norms = np.sqrt(np.square(lines_y[:, :2]).sum(1) + np.square(lines_x[:, :2]).sum(1))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        rows, across_y, across_x = (
            part / norms
            for part in (
                (hy[:, :, None] * hx[:, None]).reshape(-1, 9),
                lines_y[:, :2],
                lines_x[:, :2],
            )
        )
        return across_y, across_x, rows @ matrix.ravel(), rows @ _tangents(matrix)


def _tangents(matrix: Float64) -> Float64:
    """Orthonormal directions (9, 7) in which matrices of rank two and norm 1 change."""
    u, s, vt = np.linalg.svd(matrix)
    kept = np.diag([s[0], s[1], 0.0])
    directions = [u @ np.diag([-s[1], s[0], 0.0]) @ vt]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        turn = np.zeros((3, 3))
        turn[a, b], turn[b, a] = 1.0, -1.0
        directions += [u @ turn @ kept @ vt, u @ kept @ turn @ vt]
    return np.asarray(np.linalg.qr(np.stack([d.ravel() for d in directions], 1))[0], np.float64)


def _of_rank_two(matrix: Float64) -> Float64:
    """Return the matrix of rank two and norm 1 next to a matrix (3, 3)."""
    u, s, vt = np.linalg.svd(matrix)
    nearest: Float64 = (u * [s[0], s[1], 0.0]) @ vt / np.hypot(s[0], s[1])
    return nearest
