"""Covariances of the points of many frames, in the frame of reference that moves with the subject.

An answer's place and direction belong to its cameras, not to its structure. The same is true of
its size where no rig gives it, and of what all sizes have in common: that is their unit. So these
are projected out of what points share.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import EXTRINSICS, LENS, SIMILARITY, VIEW
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import total
from models.numerics.threads import in_slices
from models.numerics.tiny import TINY
from models.optics.lenses.projection import Lenses
from models.posterior.frame import (
    FrameCameras,
    FrameCovariance,
    ShapeFactor,
    Slopes,
    covariance_of_frame,
    make_slopes,
    middle_of,
    pose_columns,
    unknowns_of,
)

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FRAMES_AT_A_TIME = 64


class Frames(NamedTuple):
    """N answers with their cameras; see `FrameCameras` for units."""

    points: Float64  # (N, P, 3)
    rotations: Float64  # (N, K, 3, 3)
    translations: Float64  # (N, K, 3)
    lenses: Lenses  # of the K views
    joined: Bool  # (N, K)
    offsets: Float64  # (N, K, 3)
    growth: Float64  # (N,)
    keypoints: Float64  # (N, K, P, 2) pixels
    weights: Float64  # (N, K, P) inverse variances, 0 where a keypoint is not used
    turned: Float64  # (N, 3, 3) scale times rotation, from the shapes' mean to the answer
    misfits: Float64  # (N,) mean squared distance of keypoints, over their variance
    corrections: Float64  # (N, P) of the deviations that a frame leaves with known cameras


class LearntShapes(NamedTuple):
    """The shapes of a fit: x = mean + B z + e, e_p of variance eta^2 in each direction."""

    mean: Float64  # (P, 3)
    basis: Float64  # (P, 3, Q)
    variances: Float64  # (P,)


class Covariances(NamedTuple):
    """Covariances of N structures; NaN where nothing determines them."""

    blocks: Float64  # (N, P, 3, 3) of each point, all causes together
    modes: Float64  # (N, P, 3, R) what points share, given the shared cameras
    by_cameras: Float64  # (N, P, 3, T) what they share by these


def covariances_of(
    frames: Frames, shapes: LearntShapes, factor: Float64, *, modes: bool = True
) -> Covariances:
    """Return the covariances of points, given the factor L (K, 11, T) of shared cameras.

    Modes have the columns of each frame's unknowns, 0 where a frame has fewer. Without `modes`
    these and the part of the cameras are those of no frames.
    """
    out = make_covariances(len(frames.points), shapes, factor, modes)
    in_slices(
        len(frames.points),
        FRAMES_AT_A_TIME,
        lambda part: write_covariances(frames, shapes, factor, part.start, part.stop, out),
    )
    return out


@compiled
def make_covariances(
    frames: int, shapes: LearntShapes, factor: Float64, modes: bool
) -> Covariances:
    """Return room for the covariances of so many frames; see `covariances_of`."""
    points, _, size = shapes.basis.shape
    size += SIMILARITY + EXTRINSICS * len(factor)
    some = frames if modes else 0
    return Covariances(
        np.full((frames, points, 3, 3), np.nan),
        np.zeros((some, points, 3, size)),
        np.zeros((some, points, 3, factor.shape[2])),
    )


def scores_of(frames: Frames, shapes: LearntShapes) -> tuple[Float64, Float64]:
    """Return the information (11 K, 11 K) on the shared numbers, and scores (N, P, 11 K).

    Each frame follows the shared numbers. A score is the part of the gradient of the log
    likelihood that comes from the keypoints of one point in one frame.
    """
    count, views = frames.points.shape[:2], frames.joined.shape[1]
    numbers = VIEW * views
    scores, information = np.zeros((*count, numbers)), np.zeros((count[0], numbers, numbers))
    in_slices(
        len(frames.points),
        FRAMES_AT_A_TIME,
        lambda part: _scores(frames, shapes, part.start, part.stop, information, scores),
    )
    return information.sum(0), scores


@inner
def _cameras_of(frames: Frames, factor: Float64, n: int) -> FrameCameras:
    return FrameCameras(
        frames.rotations[n],
        frames.translations[n],
        frames.lenses,
        frames.joined[n],
        frames.offsets[n],
        frames.growth[n],
        factor,
    )


@inner
def _shapes_of(frames: Frames, shapes: LearntShapes, n: int) -> ShapeFactor:
    """Turn and scale the basis, and scale the variances, as the answer is."""
    count, _, size = shapes.basis.shape
    turned, columns = frames.turned[n], np.zeros(shapes.basis.shape)
    squared = 0.0
    for i in range(3):
        for j in range(3):
            squared += turned[i, j] ** 2 / 3
    for p in range(count):
        for i in range(3):
            for j in range(3):
                for q in range(size):
                    columns[p, i, q] += turned[i, j] * shapes.basis[p, j, q]
    return ShapeFactor(columns, squared * shapes.variances)


@inner
def _room_for(
    cameras: FrameCameras, shapes: ShapeFactor, count: int, shared: int
) -> FrameCovariance:
    size = unknowns_of(cameras, shapes)
    return FrameCovariance(
        np.empty((count, 3, 3)),
        np.empty((count, 3, size)),
        np.empty((count, 3, shared)),
        np.empty((size, shared)),
    )


@compiled
def write_covariances(
    frames: Frames,
    shapes: LearntShapes,
    factor: Float64,
    start: int,
    stop: int,
    out: Covariances,
) -> None:
    """Write covariances of frames from `start` to `stop`; modes only if `out` has room for them."""
    (views, count), shared = frames.weights.shape[1:], factor.shape[2]
    slopes = make_slopes(views, count, shared)
    for n in range(start, stop):
        cameras, shape = _cameras_of(frames, factor, n), _shapes_of(frames, shapes, n)
        points, weights = frames.points[n], frames.weights[n]
        found = _room_for(cameras, shape, count, shared)
        if not covariance_of_frame(points, cameras, weights, shape, slopes, found):
            continue
        axes = _gauge(points)
        size = SIMILARITY - 1 if _rig_views(cameras, weights) > 1 else SIMILARITY
        _project(axes[:size], found.modes)
        _project(axes, found.by_cameras)
        _write_blocks(found, frames.corrections[n], out.blocks[n])
        for p in range(count if len(out.modes) else 0):
            for i in range(3):
                for a in range(found.modes.shape[2]):
                    out.modes[n, p, i, a] = found.modes[p, i, a]
                for t in range(shared):
                    out.by_cameras[n, p, i, t] = found.by_cameras[p, i, t]


@inner
def _rig_views(cameras: FrameCameras, weights: Float64) -> int:
    """Return how many cameras of a static rig see the subject: two give it a size."""
    seeing = 0
    for k in range(len(cameras.joined)):
        if cameras.joined[k] and total(weights[k]) > 0:
            seeing += 1
    return seeing


@inner
def _gauge(points: Float64) -> Float64:
    """Return orthonormal directions (7, P, 3) of translations, rotations and, last, growth."""
    count, middle, size = len(points), middle_of(points), SIMILARITY
    axes = np.zeros((size, count, 3))
    for p in range(count):
        x, y, z = points[p, 0] - middle[0], points[p, 1] - middle[1], points[p, 2] - middle[2]
        for i in range(3):
            axes[i, p, i] = 1.0
        axes[3, p, 1], axes[3, p, 2] = -z, y
        axes[4, p, 0], axes[4, p, 2] = z, -x
        axes[5, p, 0], axes[5, p, 1] = -y, x
        axes[6, p, 0], axes[6, p, 1], axes[6, p, 2] = x, y, z
    rows = axes.reshape(size, 3 * count)
    for a in range(size):  # Gram and Schmidt
        for b in range(a):
            along = 0.0
            for i in range(3 * count):
                along += rows[a, i] * rows[b, i]
            for i in range(3 * count):
                rows[a, i] -= along * rows[b, i]
        squared = TINY
        for i in range(3 * count):
            squared += rows[a, i] ** 2
        for i in range(3 * count):
            rows[a, i] /= math.sqrt(squared)
    return axes


@inner
def _project(axes: Float64, columns: Float64) -> None:
    """Remove the parts along `axes` (A, P, 3) from columns (P, 3, C)."""
    count, _, size = columns.shape
    along = np.zeros((len(axes), size))
    for a in range(len(axes)):
        for p in range(count):
            for i in range(3):
                for c in range(size):
                    along[a, c] += axes[a, p, i] * columns[p, i, c]
    for a in range(len(axes)):
        for p in range(count):
            for i in range(3):
                for c in range(size):
                    columns[p, i, c] -= axes[a, p, i] * along[a, c]


@inner
def _write_blocks(found: FrameCovariance, corrections: Float64, blocks: Float64) -> None:
    """Write each point's covariance (P, 3, 3), deviations with known cameras corrected (P,)."""
    own, modes, by_cameras, _ = found
    for p in range(len(blocks)):
        for i in range(3):
            for c in range(modes.shape[2]):
                modes[p, i, c] *= corrections[p]
        for i in range(3):
            for j in range(3):
                block = own[p, i, j] * corrections[p] ** 2
                for c in range(modes.shape[2]):
                    block += modes[p, i, c] * modes[p, j, c]
                for t in range(by_cameras.shape[2]):
                    block += by_cameras[p, i, t] * by_cameras[p, j, t]
                blocks[p, i, j] = block


@compiled
def _scores(
    frames: Frames,
    shapes: LearntShapes,
    start: int,
    stop: int,
    information: Float64,
    scores: Float64,
) -> None:
    count, views = frames.points.shape[1], frames.joined.shape[1]
    numbers = VIEW * views
    factor = np.zeros((views, VIEW, numbers))
    for k in range(views):
        for number in range(VIEW):
            factor[k, number, VIEW * k + number] = 1.0
    slopes = make_slopes(views, count, numbers)
    for n in range(start, stop):
        cameras, shape = _cameras_of(frames, factor, n), _shapes_of(frames, shapes, n)
        points, weights = frames.points[n], frames.weights[n]
        found = _room_for(cameras, shape, count, numbers)
        if covariance_of_frame(points, cameras, weights, shape, slopes, found):
            off = frames.keypoints[n] - slopes.pixels
            _score(off, frames.joined[n], weights, found, slopes, information[n], scores[n])


@inner
def _score(
    off: Float64,
    joined: Bool,
    weights: Float64,
    found: FrameCovariance,
    slopes: Slopes,
    information: Float64,
    scores: Float64,
) -> None:
    """Add information on the shared numbers and scores (P, 11 K), with the frame following them.

    `off` (K, P, 2) is how far keypoints are from their pixels.
    """
    row = np.empty(len(information))
    for k in range(len(joined)):
        own, free = pose_columns(joined, k, found.modes.shape[2]), VIEW if joined[k] else LENS
        for p in range(len(scores)):
            if not weights[k, p] > 0:
                continue
            for a in range(2):
                by_numbers = slopes.by_numbers[k, p, a]
                for t in range(len(row)):
                    row[t] = 0.0
                    for i in range(3):
                        row[t] += slopes.by_point[k, p, a, i] * found.by_cameras[p, i, t]
                    for number in range(VIEW - free):
                        by_pose = by_numbers[LENS + number]
                        row[t] += by_pose * found.unknowns_by_cameras[own + number, t]
                for number in range(free):
                    row[VIEW * k + number] += by_numbers[number]
                for t in range(len(row)):
                    scores[p, t] += weights[k, p] * off[k, p, a] * row[t]
                    # The total derivative of the gradient by the shared numbers.
                    for number in range(free):
                        by_number = weights[k, p] * by_numbers[number]
                        information[VIEW * k + number, t] += by_number * row[t]
