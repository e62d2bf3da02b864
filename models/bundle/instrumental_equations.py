"""Normal equations of static cameras, linearised at keypoints from which noise was removed.

Removing noise pulls keypoints towards their usual positions. A rig that is adjusted to such
keypoints is biased by this. Detected keypoints have no such bias, but are too noisy to linearise
at. So both are used: derivatives are those at clear keypoints, right-hand sides are those of
detected ones. Noise is then in the right-hand sides alone, and causes no bias (Reiersol,
*Confluence analysis by means of instrumental sets of variables*, 1945).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.frame_equations import OUTLIER
from models.bundle.problem import LENS, VIEW, Rig
from models.capture.triangulation import triangulate
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import fill, inverse_symmetric
from models.numerics.threads import empty_aligned, in_slices
from models.numerics.tiny import TINY
from models.optics.lenses.projection import differentiate_into

Float64 = NDArray[np.float64]

NEAREST = 1e-3  # units in front of a camera
FRAMES_AT_A_TIME = 64


class NoisyFrames(NamedTuple):
    """N frames from which noise was removed, before and after."""

    clear: Float64  # (N, K, P, 2) pixels
    detected: Float64  # (N, K, P, 2) pixels
    weights: Float64  # (N, K, P) confidences, 0 where not observed
    noise: float  # pixels, standard deviation in a coordinate


class InstrumentalEquations(NamedTuple):
    """Equations of the T = 11 K shared numbers, with points eliminated, and the points' moves."""

    information: Float64  # (T, T)
    right: Float64  # (T,)
    by_shared: Float64  # (N, P, 3, T) derivative of the points by the shared numbers
    clear_moves: Float64  # (N, P, 3) to the points of clear keypoints
    detected_moves: Float64  # (N, P, 3) to those of detected keypoints
    covariances: Float64  # (N, P, 3, 3) of the latter; 0 where fewer than two views see the point
    measured: NDArray[np.bool_]  # (N, P) whether two views or more see the point


def triangulate_clear(frames: NoisyFrames, rig: Rig) -> Float64:
    """Return points (N, P, 3) in the static views' frame, as pinholes; NaN if not measured."""
    views = np.flatnonzero(rig.static)
    lenses = rig.lenses.of(views)
    flat = (frames.clear[:, views] - lenses.centres[:, None]) / lenses.focals[:, None]
    shown = np.where(frames.weights[:, views, :, None] > 0, flat, np.nan)
    poses = np.concatenate((rig.rotations[views], rig.translations[views][..., None]), -1)
    return triangulate(shown, poses, rounds=0).points3d


def linearise_at_clear(frames: NoisyFrames, rig: Rig, points: Float64) -> InstrumentalEquations:
    """Linearise at points (N, P, 3) in the frame of the static views; other views are ignored.

    A detected keypoint counts less if it is many times the noise off.
    """
    count, keypoints, _ = points.shape
    total = VIEW * len(rig.groups)
    information, right = empty_aligned(count, total, total), empty_aligned(count, total)
    equations = InstrumentalEquations(
        information,
        right,
        empty_aligned(count, keypoints, 3, total),
        empty_aligned(count, keypoints, 3),
        empty_aligned(count, keypoints, 3),
        empty_aligned(count, keypoints, 3, 3),
        np.zeros((count, keypoints), np.bool_),
    )
    there: NDArray[np.bool_] = np.all(np.isfinite(points), -1)  # (N, P)
    weights = frames.weights * rig.static[:, None] * there[:, None]
    frames = frames._replace(weights=weights)
    in_slices(
        count,
        FRAMES_AT_A_TIME,
        lambda part: _linearise(frames, rig, points, part.start, part.stop, equations),
    )
    return equations._replace(information=information.sum(0), right=right.sum(0))


@compiled
def _linearise(
    frames: NoisyFrames,
    rig: Rig,
    points: Float64,
    start: int,
    stop: int,
    out: InstrumentalEquations,
) -> None:
    views = len(frames.weights[0])
    by_point, by_view = np.empty((views, 2, 3)), np.empty((views, 2, VIEW))
    residuals, own = np.empty((2, views, 2)), np.empty(views)
    inverse, coupling = np.empty((3, 3)), np.empty((3, VIEW * views))
    for n in range(start, stop):
        fill(out.information[n], 0)
        fill(out.right[n], 0)
        for p in range(points.shape[1]):
            seen = 0
            for k in range(views):
                own[k] = 0.0
                if frames.weights[n, k, p] > 0:
                    own[k] = _differentiate(
                        frames, rig, points[n, p], n, k, p, by_point[k], by_view[k], residuals
                    )
                seen += own[k] > 0
            out.measured[n, p] = seen > 1
            for moves in (out.clear_moves[n, p], out.detected_moves[n, p]):
                fill(moves, 0)
            fill(out.by_shared[n, p], 0)
            fill(out.covariances[n, p], 0)
            if seen > 1:
                _eliminate(n, p, own, by_point, by_view, residuals, inverse, coupling, out)


@inner
def _differentiate(
    frames: NoisyFrames,
    rig: Rig,
    point: Float64,
    n: int,
    k: int,
    p: int,
    by_point: Float64,
    by_view: Float64,
    residuals: Float64,
) -> float:
    """Write derivatives and both residuals of a pixel; return its weight, 0 behind the camera."""
    arm, camera, pixel = np.empty(3), np.empty(3), np.empty(2)
    by_camera, by_lens = np.empty((2, 3)), np.empty((2, LENS))
    rotation = rig.rotations[k]
    for i in range(3):
        arm[i] = rotation[i, 0] * point[0] + rotation[i, 1] * point[1] + rotation[i, 2] * point[2]
        camera[i] = arm[i] + rig.translations[k, i]
    if camera[2] < NEAREST:
        return 0.0
    differentiate_into(camera, rig.lenses, k, pixel, by_camera, by_lens)
    squared = 0.0
    for a in range(2):
        clear, detected = frames.clear[n, k, p, a], frames.detected[n, k, p, a]
        residuals[0, k, a], residuals[1, k, a] = clear - pixel[a], detected - pixel[a]
        squared += (detected - clear) ** 2
        by = by_camera[a]
        for i in range(LENS):
            by_view[a, i] = by_lens[a, i]
        by_view[a, LENS] = arm[1] * by[2] - arm[2] * by[1]
        by_view[a, LENS + 1] = arm[2] * by[0] - arm[0] * by[2]
        by_view[a, LENS + 2] = arm[0] * by[1] - arm[1] * by[0]
        for i in range(3):
            by_view[a, LENS + 3 + i] = by[i]
            by_point[a, i] = (
                by[0] * rotation[0, i] + by[1] * rotation[1, i] + by[2] * rotation[2, i]
            )
    away = math.sqrt(squared) / frames.noise
    weight: float = frames.weights[n, k, p] * min(1.0, OUTLIER / max(away, TINY))
    return weight / frames.noise**2


@inner
def _eliminate(
    n: int,
    p: int,
    own: Float64,
    by_point: Float64,
    by_view: Float64,
    residuals: Float64,
    inverse: Float64,
    coupling: Float64,
    out: InstrumentalEquations,
) -> None:
    """Add a point's equations of the shared numbers, and write its derivative by them."""
    fill(inverse, 0)
    fill(coupling, 0)
    clear, detected = out.clear_moves[n, p], out.detected_moves[n, p]
    information, right, by_shared = out.information[n], out.right[n], out.by_shared[n, p]
    pulls = np.zeros((2, 3))
    for k in range(len(own)):
        if own[k] > 0:
            at = VIEW * k
            _add_view(
                own[k], by_point[k], by_view[k], residuals[:, k], at, inverse, coupling, pulls
            )
            _add_shared(own[k], by_view[k], residuals[1, k], at, information, right)
    inverse_symmetric(inverse, TINY, out.covariances[n, p])
    for i in range(3):
        for j in range(3):
            unsure = out.covariances[n, p, i, j]
            clear[i] += unsure * pulls[0, j]
            detected[i] += unsure * pulls[1, j]
            for s in range(len(right)):
                by_shared[i, s] -= unsure * coupling[j, s]
    for s in range(len(right)):
        for i in range(3):
            u = coupling[i, s]
            right[s] -= u * detected[i]
            if u != 0.0:
                for r in range(len(right)):
                    information[s, r] += u * by_shared[i, r]


@inner
def _add_view(
    weight: float,
    by_point: Float64,
    by_view: Float64,
    residuals: Float64,
    at: int,
    inverse: Float64,
    coupling: Float64,
    pulls: Float64,
) -> None:
    """Add a view's information on a point."""
    for a in range(2):
        for i in range(3):
            u = weight * by_point[a, i]
            for j in range(3):
                inverse[i, j] += u * by_point[a, j]
            for j in range(VIEW):
                coupling[i, at + j] += u * by_view[a, j]
            pulls[0, i] += u * residuals[0, a]
            pulls[1, i] += u * residuals[1, a]


@inner
def _add_shared(
    weight: float,
    by_view: Float64,
    residual: Float64,
    at: int,
    information: Float64,
    right: Float64,
) -> None:
    """Add a view's equations of its shared numbers, as if the point were known."""
    for a in range(2):
        for i in range(VIEW):
            u = weight * by_view[a, i]
            right[at + i] += u * residual[a]
            for j in range(VIEW):
                information[at + i, at + j] += u * by_view[a, j]
