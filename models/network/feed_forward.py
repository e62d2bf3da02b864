"""The compiled network: from the keypoints of a frame to its structure and cameras, in one call.

The prior in torch is for training: differentiable, in batches. Here a fitted network answers frame
by frame, so that all numbers of a frame stay in the processor's nearest cache.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import Observations
from models.network.answers import OTHER_SCALE, UNLIKE_FIT, Answers, Usual
from models.network.priors.dispatch import decode_into, encode_into
from models.network.priors.prior import Weights
from models.network.reprojection_kernels import fill_view_into
from models.network.settling import ROUNDS, SettlingPolicy
from models.network.settling_kernels import Buffers, mirror_frame, new_buffers, settle_frame
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, total
from models.numerics.normalisation import normalise_into
from models.numerics.rotations import nearest_orthonormal_rows_into
from models.optics.weak_perspective import project_into, solve_camera_into

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_WEIGHT = np.float32(1e-6)  # less would divide by zero
LEAST_SCALE = 1e-6


@compiled
def feed_forward(
    network: Weights,
    seen: Observations,
    foreshortening: float,
    policy: SettlingPolicy,
    usual: Usual,
    start: int,
    stop: int,
    answers: Answers,
) -> None:
    """Compute weak-perspective answers for frames from `start` to `stop`; NaN where there is none.

    Frames unlike those of the fit are marked in the answers' findings.

    The policy decides which frames are settled. A structure that is not settled is mirrored if
    `foreshortening` is negative. If it is 0, the fit could not estimate it, and structures keep
    the handedness of the network.
    """
    _, views, count, _ = seen.keypoints.shape
    filled = np.empty((views, count, 2), np.float32)
    guesses, points = np.empty((views, 3, 3)), np.empty((count, 3))
    buffers = new_buffers(views, count)
    for n in range(start, stop):
        keypoints, weights = seen.keypoints[n], seen.weights[n]
        _write_no_answer(answers, n, weights)
        if total(seen.usable[n]) == 0:
            continue
        _reconstruct(network, keypoints, weights, points, guesses)
        if _hides_keypoints(weights):
            # Hidden keypoints are filled with their reprojections, and the views are encoded again.
            _fill_views(keypoints, weights, points, guesses, buffers, filled)
            _reconstruct(network, filled, weights, points, guesses)
        misfit = _misfit(points, keypoints, weights, guesses, buffers)
        _note(answers, n, seen.usable[n], seen.sizes[n], misfit, usual)
        if foreshortening != 0:
            if policy.every_frame or misfit > policy.misfit_limit:
                settle_frame(points, keypoints, weights, guesses, foreshortening, ROUNDS, buffers)
            elif foreshortening < 0:
                mirror_frame(points, guesses)
        copy(points, answers.points3d[n])
        for k in range(views):
            if seen.usable[n, k]:
                _write_camera(answers, seen, n, k, points, guesses[k], buffers)


@inner
def _write_no_answer(answers: Answers, n: int, weights: Float32) -> None:
    """Write frame n without structure and cameras, and the counts of its keypoints."""
    fill(answers.points3d[n], np.nan)
    answers.continued[n] = False
    answers.findings[n] = 0
    answers.sizes[n] = answers.misfits[n] = answers.rig_residuals[n] = np.nan
    for p in range(weights.shape[1]):
        views = 0
        for k in range(len(weights)):
            views += weights[k, p] > 0
        answers.keypoints_seen[n, p] = views
    for k in range(len(weights)):
        fill(answers.rotations[n, k], np.nan)
        answers.scales[n, k] = np.nan
        fill(answers.translations[n, k], np.nan)
        fill(answers.focals[n, k], np.nan)
        fill(answers.principal_points[n, k], np.nan)
        fill(answers.distortions[n, k], np.nan)
        answers.camera_models[n, k] = -1
        answers.reprojection_errors[n, k] = np.nan
        used = 0
        for p in range(weights.shape[1]):
            used += weights[k, p] > 0
        answers.keypoints_used[n, k] = used


@inner
def _note(
    answers: Answers, n: int, usable: Bool, sizes: Float32, misfit: float, usual: Usual
) -> None:
    """Write the misfit and the size of frame n, and whether they are outside the usual range."""
    summed, views, found = 0.0, 0, 0
    for k in range(len(usable)):
        if usable[k]:
            summed += sizes[k]
            views += 1
            if not usual.least_size <= sizes[k] <= usual.most_size:
                found = OTHER_SCALE
    if misfit > usual.misfits[min(views, len(usual.misfits)) - 1]:
        found += UNLIKE_FIT
    answers.sizes[n], answers.misfits[n] = summed / max(views, 1), misfit
    answers.findings[n] = found


@inner
def _write_camera(
    answers: Answers,
    seen: Observations,
    n: int,
    k: int,
    points: Float64,
    guess: Float64,
    buffers: Buffers,
) -> None:
    """Solve for the camera of view k of frame n and write it, in pixels."""
    keypoints, weights = seen.keypoints[n, k], seen.weights[n, k]
    camera, projected, size = buffers.camera, buffers.projected[k], seen.sizes[n, k]
    scale = solve_camera_into(points, keypoints, weights, total(weights), guess, camera).scale
    project_into(points, camera, scale, projected)
    copy(camera.rotation, answers.rotations[n, k])
    answers.scales[n, k] = scale * size
    for i in range(2):
        answers.translations[n, k, i] = camera.translation[i] * size + seen.centres[n, k, i]
    answers.reprojection_errors[n, k] = _mean_distance(projected, keypoints, weights) * size
    answers.camera_models[n, k] = 0


@inner
def _reconstruct(
    network: Weights, seen: Float32, weights: Float32, points: Float64, guesses: Float64
) -> None:
    """See `models.network.priors.prior.Prior`: encode views (K, P, 2), pool, decode to (P, 3)."""
    views, size = len(seen), network.code_size
    codes = np.empty((views, size), np.float32)
    matrices = np.empty((views, 2, 3))
    encode_into(network, seen, codes, matrices)
    votes = np.float32(0)
    for k in range(views):
        votes += total(weights[k])
    code = np.zeros(size, np.float32)
    for k in range(views):
        nearest_orthonormal_rows_into(matrices[k], guesses[k])
        vote = total(weights[k]) / max(votes, LEAST_WEIGHT)
        if vote > 0:
            for i in range(size):
                code[i] += vote * codes[k, i]
    decode_into(network, code, points)
    normalise_into(points, points)


@inner
def _hides_keypoints(weights: Float32) -> bool:
    """Return whether a usable view of `weights` (K, P) has keypoints without full weight."""
    hidden = False
    for k in range(len(weights)):
        hidden = hidden or 0 < total(weights[k]) < weights.shape[1]
    return hidden


@inner
def _fill_views(
    keypoints: Float32,
    weights: Float32,
    points: Float64,
    guesses: Float64,
    buffers: Buffers,
    filled: Float32,
) -> None:
    """Fill the hidden keypoints of views (K, P, 2) with their reprojections, and normalise."""
    camera = buffers.camera
    for k in range(len(keypoints)):
        projected = buffers.projected[k]
        whole = total(weights[k])
        if whole > 0:
            scale = solve_camera_into(
                points, keypoints[k], weights[k], whole, guesses[k], camera
            ).scale
            project_into(points, camera, scale, projected)
            fill_view_into(projected, keypoints[k], weights[k], filled[k], filled[k])
        else:
            fill(filled[k], 0)


@inner
def _misfit(
    points: Float64, keypoints: Float32, weights: Float32, guesses: Float64, buffers: Buffers
) -> float:
    """Return the mean reprojection error of a frame's observed keypoints, in structure units."""
    camera, summed, number = buffers.camera, 0.0, 0
    for k in range(len(keypoints)):
        observed = 0
        for p in range(len(points)):
            observed += weights[k, p] > 0
        if observed:
            scale = solve_camera_into(
                points, keypoints[k], weights[k], total(weights[k]), guesses[k], camera
            ).scale
            project_into(points, camera, scale, buffers.projected[k])
            error = _mean_distance(buffers.projected[k], keypoints[k], weights[k])
            summed += observed * error / max(scale, LEAST_SCALE)
            number += observed
    return summed / max(number, 1)


@inner
def _mean_distance(projected: Float64, keypoints: Float32, weights: Float32) -> float:
    """Return the mean reprojection error of the observed keypoints of one view (P, 2)."""
    summed, observed = 0.0, 0
    for p in range(len(weights)):
        if weights[p] > 0:
            u, v = projected[p, 0] - keypoints[p, 0], projected[p, 1] - keypoints[p, 1]
            summed += math.sqrt(u * u + v * v)
            observed += 1
    return summed / max(observed, 1)
