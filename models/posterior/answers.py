"""Answers of lifts as the frames of a posterior; compiled."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle.problem import Rig, stretch_x
from models.capture.observations import Observations
from models.network.answers import RIG_NOT_USED, Answers
from models.numerics.compiled import compiled, inner
from models.numerics.rotations import nearest_rotation_into
from models.numerics.threads import in_slices
from models.numerics.tiny import TINY
from models.optics.lenses.projection import project, project_into
from models.posterior.frame import middle_of
from models.posterior.frames import FRAMES_AT_A_TIME, Frames, LearntShapes

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Student's t: a keypoint that lies further off than most counts less. None counts for more than
# one of white noise.
FREEDOM = 4.0
FURTHEST = 50.0  # squared distance that a keypoint counts for in the misfit of its frame
STEP = 1e-5  # of the largest coordinate, for differences of pixels


class Noise(NamedTuple):
    """What K views of a lift are known to have of it, and what a lift leaves of it."""

    deviations: Float64  # (K, P) pixels, of a coordinate of confidence 1
    # Of frames one by one, and of frames that were smoothed in time: the share that is left before
    # a lift, and corrections of points that no view shows, one view, two, ...
    left: Float64  # (2,)
    corrections: Float64  # (2, V + 1), of V >= K views


class Lifted(NamedTuple):
    """A lift of N frames, its keypoints, and what a fit knows of both."""

    answers: Answers  # refined ones with all their points
    rig: Rig  # of the K views of the answers
    seen: Observations
    # Keypoints before noise was removed, and how it was, as in `ObservedFrames`
    detected: Float32
    smoothed: Bool
    shapes: LearntShapes
    noise: Noise


def frames_of(
    answers: Answers,
    rig: Rig,
    mean: Float64,
    keypoints: Float64,
    weights: Float64,
    noise: Float64,
) -> Frames:
    """Return the frames of a lift with all its points; without a camera a view counts for nothing.

    Parameters
    ----------
    rig
        Of the K views of the lift.
    mean
        (P, 3) of the shapes.
    keypoints, weights
        (N, K, P, 2) pixels as they were detected, and (N, K, P) confidences, 0 where not used.
    noise
        (K, P) pixels, standard deviations of a coordinate of confidence 1.
    """
    count = len(weights)
    frames = make_frames(np.ascontiguousarray(keypoints), rig)
    given = np.ascontiguousarray(weights)
    in_slices(
        count,
        FRAMES_AT_A_TIME,
        lambda part: fill_frames(
            answers, rig, mean, given, noise, part.start, part.stop, 0, frames
        ),
    )
    return frames


def reprojected(frames: Frames, points: Float64) -> Float64:
    """Return the pixels (N, K, P, 2) of points (N, P, 3); any number without a camera."""
    held = points[:, None] @ frames.rotations.mT + frames.translations[:, :, None]
    held[..., 2] = np.where(held[..., 2] > 0, held[..., 2], 1.0)
    return project(held, frames.lenses)


def derivatives_of(frames: Frames) -> tuple[Float64, Float64]:
    """Return derivatives (N, K, P, 2, 3) of pixels by points, and the pixels (N, K, P, 2)."""
    points = frames.points
    step = STEP * float(np.abs(points).max())
    ahead, behind = (
        np.stack([reprojected(frames, points + way * step * axis) for axis in np.eye(3)], -1)
        for way in (1, -1)
    )
    return (ahead - behind) / (2 * step), reprojected(frames, points)


@compiled
def make_frames(keypoints: Float64, rig: Rig) -> Frames:
    """Return frames of keypoints (N, K, P, 2); all else is to be written."""
    count, views, points, _ = keypoints.shape
    return Frames(
        np.empty((count, points, 3)),
        np.empty((count, views, 3, 3)),
        np.empty((count, views, 3)),
        rig.lenses,
        np.empty((count, views), np.bool_),
        np.empty((count, views, 3)),
        np.empty(count),
        keypoints,
        np.empty((count, views, points)),
        np.empty((count, 3, 3)),
        np.zeros(count),
        np.ones((count, points)),
    )


@compiled
def frames_as_detected(lifted: Lifted, start: int, stop: int) -> Frames:
    """Return frames from `start` to `stop` with keypoints as they were before noise was removed."""
    answers, rig, seen, detected, smoothed, shapes, noise = lifted
    some, (views, count) = stop - start, noise.deviations.shape
    keypoints, weights = np.zeros((some, views, count, 2)), np.zeros((some, views, count))
    for n in range(start, stop):
        for k in range(views):
            for p in range(count):
                weights[n - start, k, p] = seen.weights[n, k, p]
                known = len(detected) > 0 and detected[n, k, p, 2] > 0
                for i in range(2):
                    pixel = seen.keypoints[n, k, p, i] * seen.sizes[n, k] + seen.centres[n, k, i]
                    keypoints[n - start, k, p, i] = detected[n, k, p, i] if known else pixel
    frames = make_frames(keypoints, rig)
    fill_frames(answers, rig, shapes.mean, weights, noise.deviations, start, stop, start, frames)
    for n in range(some):
        removed = int(smoothed[start + n])
        for p in range(count):
            showing = 0
            for k in range(views):
                if weights[n, k, p] > 0:
                    showing += 1
                # Only now: how far a keypoint lies off is judged by the noise that it had.
                frames.weights[n, k, p] /= noise.left[removed] ** 2
            frames.corrections[n, p] = noise.corrections[removed, showing]
    return frames


@compiled
def fill_frames(
    answers: Answers,
    rig: Rig,
    mean: Float64,
    given: Float64,
    noise: Float64,
    start: int,
    stop: int,
    first: int,
    out: Frames,
) -> None:
    """Write frames from `start` to `stop`; those of `out` and `given` (K, P) begin at `first`."""
    views, count = noise.shape
    members = np.zeros(len(rig.groups))
    for k in range(views):
        members[rig.groups[k]] += 1
    for n in range(start, stop):
        m = n - first
        for p in range(count):
            for i in range(3):
                out.points[m, p, i] = answers.points3d[n, p, i]
        apart = answers.findings[n] & RIG_NOT_USED
        for k in range(views):
            placed = answers.camera_models[n, k] > 0
            out.joined[m, k] = placed and not apart and members[rig.groups[k]] > 1
            for i in range(3):
                out.translations[m, k, i] = answers.translations[n, k, i] if placed else 0.0
                for j in range(3):
                    out.rotations[m, k, i, j] = answers.rotations[n, k, i, j] if placed else 0.0
            if placed and rig.stretched[k]:  # which the lens of the rig does not have
                stretch = answers.focals[n, k, 0] / rig.lenses.focals[k, 0]
                stretch_x(out.rotations[m, k], out.translations[m, k], stretch)
        out.growth[m] = _growth(out.rotations[m], out.translations[m], out.joined[m], rig)
        for k in range(views):
            for i in range(3):
                out.offsets[m, k, i] = out.growth[m] * rig.translations[k, i]
        _weigh(given[m], noise, m, out)
        _turn_into(out.points[m], mean, out.turned[m])


@inner
def _weigh(given: Float64, noise: Float64, n: int, out: Frames) -> None:
    """Write the robust weights of a frame, and how far its keypoints are off; `given` is (K, P)."""
    points, rotations, translations, lenses, _, _, _, keypoints, weights, _, misfits, _ = out
    camera, pixel, (views, count) = np.empty(3), np.empty(2), noise.shape
    used, misfit = 0, 0.0
    for k in range(views):
        for p in range(count):
            weights[n, k, p] = 0.0
            weight = given[k, p] / noise[k, p] ** 2
            if not weight > 0:
                continue
            for i in range(3):
                camera[i] = translations[n, k, i]
                for j in range(3):
                    camera[i] += rotations[n, k, i, j] * points[n, p, j]
            if not camera[2] > 0:  # or there is no camera
                continue
            project_into(camera, lenses, k, pixel)
            x, y = keypoints[n, k, p, 0] - pixel[0], keypoints[n, k, p, 1] - pixel[1]
            squared = weight * (x * x + y * y)
            if squared < np.inf:
                weights[n, k, p] = weight * min((FREEDOM + 2) / (FREEDOM + squared), 1.0)
                misfit += min(squared, FURTHEST) / 2
                used += 1
    misfits[n] = misfit / used if used else np.nan


@inner
def _growth(rotations: Float64, translations: Float64, used: NDArray[np.bool_], rig: Rig) -> float:
    """Return the units of the structure in a unit of the rig, from distances of its cameras.

    1 where fewer than two cameras of the rig see a frame.
    """
    ours, theirs, first = 0.0, 0.0, -1
    for k in range(len(used)):
        if not used[k]:
            continue
        if first < 0:
            first = k
        for i in range(3):
            here, there = 0.0, 0.0
            for j in range(3):
                here -= rotations[k, j, i] * translations[k, j]
                here += rotations[first, j, i] * translations[first, j]
                there -= rig.rotations[k, j, i] * rig.translations[k, j]
                there += rig.rotations[first, j, i] * rig.translations[first, j]
            ours += here * here
            theirs += there * there
    return math.sqrt(ours / theirs) if theirs > TINY else 1.0


@inner
def _turn_into(points: Float64, mean: Float64, out: Float64) -> None:
    """Write scale times rotation from `mean` to the points, by least squares (Umeyama, 1991)."""
    overlap, squared = np.zeros((3, 3)), 0.0
    centre, middle = middle_of(points), middle_of(mean)
    for p in range(len(points)):
        for i in range(3):
            squared += (mean[p, i] - middle[i]) ** 2
            for j in range(3):
                overlap[i, j] += (points[p, i] - centre[i]) * (mean[p, j] - middle[j])
    nearest_rotation_into(overlap, out)
    scale = 0.0
    for i in range(3):
        for j in range(3):
            scale += out[i, j] * overlap[i, j] / max(squared, TINY)
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale
