"""Constant lengths of the skeleton's edges: learnt by a fit, held in its lifts.

Noise makes limbs of a structure longer and shorter from frame to frame. The length of an edge and
its true variation are estimated from all frames together (`learn_skeleton_lengths`). The points of
a frame are then moved so that its edges have these lengths (`hold_lengths`). They move most where
they are least certain: along the rays of few cameras. Edges that truly stretch stay as they are.

`models.bundle.bone_lengths` is another matter: distances between any keypoints, to estimate lenses.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, Views
from models.lifting.lift import LiftedFrames
from models.lifting.point_information import inform_points
from models.network.answers import RIG_NOT_USED
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import (
    cholesky,
    cholesky_solve,
    copy,
    inverse_symmetric,
)
from models.numerics.random_effects import random_effects
from models.numerics.tensor_files import Arrays, Shapes, WeightsError, as_tensors
from models.numerics.threads import empty_aligned, in_slices
from models.numerics.tiny import TINY
from models.optics.lenses.projection import Lenses

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Figures: evidence/lifts.md.
# Lengths are in units of the structure: the usual distance of a keypoint from the middle is 1.
LEAST_SCATTER = 0.007  # keypoints do not sit on bones, so no length is held steadier
UNCERTAINTY = 0.1  # standard deviation of a keypoint that no view shows
LEAST_FRAMES = 40  # in which two views show both ends
MOST_EDGES = 128  # held at once: a frame takes the cube of their number
STEPS, CONVERGED = 8, 1e-5  # of Gauss-Newton, and the last one worth taking
FRAMES_AT_A_TIME = 64


class SkeletonLengths(NamedTuple):
    """Lengths of E edges of a skeleton; of none, where nothing is to be held."""

    ends: Int64  # (2, E) keypoints
    lengths: Float64  # (E,)
    scatter: Float64  # (E,) standard deviation from frame to frame
    noise: float  # pixels, standard deviation in a coordinate as it was detected

    def to_arrays(self) -> Arrays:
        """Return the lengths as tensors, for a file."""
        return as_tensors(self._asdict())

    @classmethod
    def shapes(cls) -> Shapes:
        """Shapes of what `to_arrays` returns; None stands for any length."""
        return {"ends": (2, None), "lengths": (None,), "scatter": (None,), "noise": (1,)}

    @classmethod
    def from_arrays(cls, arrays: Arrays, keypoints: int) -> "SkeletonLengths":
        """Read what `to_arrays` returned, of so many keypoints.

        Raises
        ------
        WeightsError
            When the tensors contradict each other.
        """
        ends, lengths, scatter = (arrays[name].numpy() for name in ("ends", "lengths", "scatter"))
        noise = arrays["noise"].item()
        whole = bool((ends == np.floor(ends)).all() and ((ends >= 0) & (ends < keypoints)).all())
        same = ends.shape[1] == len(lengths) == len(scatter) <= MOST_EDGES
        positive = noise > 0 and bool((lengths > 0).all() and (scatter > 0).all())
        if not (whole and same and positive) or (ends[0] == ends[1]).any():
            raise WeightsError("the file contradicts itself about the skeleton")
        return cls(np.ascontiguousarray(ends, np.int64), lengths, scatter, noise)


def no_lengths() -> SkeletonLengths:
    """Return the lengths of no edges."""
    return SkeletonLengths(np.zeros((2, 0), np.int64), np.zeros(0), np.zeros(0), 1.0)


def learn_skeleton_lengths(
    edges: Int64, lift: LiftedFrames, seen: Views, rig: Rig, *, unit: float, noise: float
) -> SkeletonLengths | None:
    """Learn the lengths of those `edges` (E, 2) that stay the same; None if there are none.

    An edge's length is measured in every frame along its direction in the lift, from the keypoints
    as they were detected, with the variance due to their noise. An edge is used if this variance
    is larger than that of its true length; otherwise every frame measures its own length better.

    Parameters
    ----------
    lift
        A refined lift of all views of the fit, with structures in the user's unit.
    seen
        The keypoints of the lift as they were detected, with confidences (N, K, P) as weights.
    rig
        A static rig of one group.
    unit
        A unit of the structure, in the user's unit.
    noise
        Standard deviation of a detected coordinate, pixels.
    """
    refined = (lift.camera_models > 0) & ((lift.findings & RIG_NOT_USED) == 0)[:, None]  # (N, K)
    frames = refined.sum(1) > 1
    ends = np.ascontiguousarray(edges.T)
    lengths, variances = (empty_aligned(int(frames.sum()), len(edges)) for _ in range(2))
    views = refined[frames]
    posed = (
        np.asarray(lift.points3d[frames], np.float64) / unit,
        np.where(views[..., None, None], lift.rotations[frames], 0).astype(np.float64),
        np.where(views[..., None], lift.translations[frames] / unit, 1).astype(np.float64),
    )
    weights = np.where(views[..., None], seen.weights[frames], 0) / noise**2
    shown = Views(np.ascontiguousarray(seen.keypoints[frames]), np.ascontiguousarray(weights))
    in_slices(
        len(lengths),
        FRAMES_AT_A_TIME,
        lambda part: _measure(
            *posed, rig.lenses, shown, ends, part.start, part.stop, lengths, variances
        ),
    )
    means, scatter = random_effects(lengths, variances)
    scatter = np.hypot(scatter, LEAST_SCATTER)
    often = np.isfinite(variances).sum(0) >= LEAST_FRAMES
    hidden = 1 / (1 / variances).mean(0, where=np.isfinite(variances)).clip(TINY)  # (E,)
    taken = np.flatnonzero(often & (hidden > scatter**2) & (means > scatter))[:MOST_EDGES]
    if not len(taken):
        return None
    return SkeletonLengths(
        np.ascontiguousarray(ends[:, taken]), means[taken], scatter[taken], noise
    )


@inner
def hold_lengths(
    held: SkeletonLengths,
    views: Views,
    noise: float,
    lenses: Lenses,
    points: Float64,
    rotations: Float64,
    translations: Float64,
) -> None:
    """Move the points (P, 3) of a frame so that its edges have their lengths, in place.

    Its cameras (K, 3, 3) and (K, 3) stay. The weights of its `views` are inverse variances for
    noise of standard deviation `noise`. The prior of the points is Gaussian about where they were,
    with the covariance that views and the noise of detected keypoints give them. The prior of the
    lengths is Gaussian too.
    """
    count, edges = len(points), len(held.lengths)
    information, pull = np.empty((count, 3, 3)), np.empty((count, 3))
    inform_points(points, rotations, translations, lenses, views, information, pull)
    unsure, before = np.empty((count, 3, 3)), points.copy()
    trust = (noise / held.noise) ** 2
    for p in range(count):
        for i in range(3):
            for j in range(3):
                information[p, i, j] *= trust
        inverse_symmetric(information[p], 1 / UNCERTAINTY**2, unsure[p])
    along, right = np.empty((edges, 3)), np.empty(edges)
    carried, system = np.empty((2, edges, 3)), np.empty((edges, edges))
    for _ in range(STEPS):
        _linearise(held, points, before, unsure, along, carried, right, system)
        if not cholesky(system):
            copy(before, points)
            return
        cholesky_solve(system, right)
        if _step(held, before, carried, right, points) < CONVERGED:
            return


@inner
def _linearise(
    held: SkeletonLengths,
    points: Float64,
    before: Float64,
    unsure: Float64,
    along: Float64,
    carried: Float64,
    right: Float64,
    system: Float64,
) -> None:
    """Write edges' directions (E, 3), covariances of ends with lengths (2, E, 3), and the system.

    The solution of the system is how far each end is moved along its covariance.
    """
    first, second = held.ends
    for e in range(len(right)):
        a, b = first[e], second[e]
        length = 0.0
        for i in range(3):
            along[e, i] = points[a, i] - points[b, i]
            length += along[e, i] ** 2
        length = math.sqrt(max(length, TINY))
        right[e] = held.lengths[e] - length
        for i in range(3):
            along[e, i] /= length
            moved = points[a, i] - before[a, i] - points[b, i] + before[b, i]
            right[e] += along[e, i] * moved
        for i in range(3):
            carried[0, e, i] = carried[1, e, i] = 0.0
            for j in range(3):
                carried[0, e, i] += unsure[a, i, j] * along[e, j]
                carried[1, e, i] -= unsure[b, i, j] * along[e, j]
    for e in range(len(right)):
        for f in range(e + 1):
            shared = 0.0
            for i in range(3):
                if first[e] == first[f]:
                    shared += carried[0, e, i] * along[f, i]
                if first[e] == second[f]:
                    shared -= carried[0, e, i] * along[f, i]
                if second[e] == first[f]:
                    shared += carried[1, e, i] * along[f, i]
                if second[e] == second[f]:
                    shared -= carried[1, e, i] * along[f, i]
            system[e, f] = shared
        system[e, e] += held.scatter[e] ** 2


@inner
def _step(
    held: SkeletonLengths, before: Float64, carried: Float64, solved: Float64, points: Float64
) -> float:
    """Write the points after a step; returns the largest change of a coordinate."""
    last, change = points.copy(), 0.0
    copy(before, points)
    for e in range(len(solved)):
        for end in range(2):
            p = held.ends[end, e]
            for i in range(3):
                points[p, i] += carried[end, e, i] * solved[e]
    for p in range(len(points)):
        for i in range(3):
            change = max(change, abs(points[p, i] - last[p, i]))
    return change


@compiled
def _measure(
    points: Float64,
    rotations: Float64,
    translations: Float64,
    lenses: Lenses,
    seen: Views,
    ends: Int64,
    start: int,
    stop: int,
    lengths: Float64,
    variances: Float64,
) -> None:
    """Measure lengths (N, E) along the edges' directions; variances are infinite if unmeasured."""
    count = points.shape[1]
    information, pull, unsure = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((3, 3))
    shown_in, moved = np.empty(count), np.empty((count, 3))
    spread = np.empty((count, 3, 3))
    for n in range(start, stop):
        views = Views(seen.keypoints[n], seen.weights[n])
        inform_points(points[n], rotations[n], translations[n], lenses, views, information, pull)
        for p in range(count):
            shown_in[p] = (views.weights[:, p] > 0).sum()
            inverse_symmetric(information[p], TINY, unsure)
            for i in range(3):
                moved[p, i] = points[n, p, i]
                for j in range(3):
                    spread[p, i, j] = unsure[i, j]
                    moved[p, i] += unsure[i, j] * pull[p, j]
        for e in range(ends.shape[1]):
            a, b = ends[0, e], ends[1, e]
            along = points[n, a] - points[n, b]
            squared = (along * along).sum()
            lengths[n, e], variances[n, e] = 0.0, np.inf
            if min(shown_in[a], shown_in[b]) < 2 or squared < TINY:
                continue
            along /= math.sqrt(squared)
            variance = 0.0
            for i in range(3):
                lengths[n, e] += along[i] * (moved[a, i] - moved[b, i])
                for j in range(3):
                    variance += along[i] * (spread[a, i, j] + spread[b, i, j]) * along[j]
            variances[n, e] = variance
