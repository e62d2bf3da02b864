"""The compiled network: what the prior and `models.network.settling` compute, frame by frame.

Those are for training: differentiable, in batches. Here a fitted network answers. The numbers of a
frame stay in the processor's nearest cache from its keypoints to its answer, all in one call.
"""

import math

import numpy as np
from numpy.typing import NDArray

from models.capture.observations import Observations
from models.network.answers import Answers
from models.network.priors.dispatch import decode_into, encode_into
from models.network.priors.prior import Weights
from models.network.settling import DECISIVE, ROUNDS, STIFFNESS, SettlingPolicy
from models.numerics.compiled import compiled, inner
from models.numerics.matrices import copy, fill, inverse, total
from models.numerics.rotations import nearest_orthonormal_rows_into
from models.optics.weak_perspective import RIDGE, TINY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

LEAST_WEIGHT = np.float32(1e-6)


@compiled
def feed_forward(
    network: Weights,
    seen: Observations,
    foreshortening: float,
    policy: SettlingPolicy,
    start: int,
    stop: int,
    answers: Answers,
) -> None:
    """Write weak-perspective answers for frames from `start` to `stop`; NaN where there is none.

    The policy says which frames are settled. A structure that is not settled is mirrored if
    `foreshortening` is negative.
    """
    _, views, count, _ = seen.keypoints.shape
    filled = np.empty((views, count, 2), np.float32)
    guesses, rotations = np.empty((views, 3, 3)), np.empty((views, 3, 3))
    shift, points = np.empty(2), np.empty((count, 3))
    turned = np.empty((count, 3))
    for n in range(start, stop):
        keypoints, weights = seen.keypoints[n], seen.weights[n]
        answers.continued[n] = False
        fill(answers.points3d[n], np.nan)
        _blank(answers, n, weights)
        if total(seen.usable[n]) == 0:
            continue
        _reconstruct(network, keypoints, weights, points, guesses)
        if _fill(keypoints, weights, points, guesses, filled):
            # What is hidden is filled with its reprojection and the views are read once more.
            _reconstruct(network, filled, weights, points, guesses)
        if foreshortening != 0:  # where the fit could tell it
            if (
                policy.every_frame
                or _misfit(points, keypoints, weights, guesses) > policy.misfit_limit
            ):
                _settle(points, keypoints, weights, guesses, foreshortening, turned, rotations)
            elif foreshortening < 0:
                _mirror(points, guesses)
        copy(points, answers.points3d[n])
        for k in range(views):
            if not seen.usable[n, k]:
                continue
            size, rotation = seen.sizes[n, k], rotations[k]
            scale = _solve_camera(points, keypoints[k], weights[k], guesses[k], rotation, shift)
            error = _mean_distance(points, keypoints[k], weights[k], rotation, scale, shift)
            copy(rotation, answers.rotations[n, k])
            answers.scales[n, k] = scale * size
            for i in range(2):
                answers.translations[n, k, i] = shift[i] * size + seen.centres[n, k, i]
            answers.reprojection_errors[n, k] = error * size
            answers.camera_models[n, k] = 0


@inner
def _blank(answers: Answers, n: int, weights: Float32) -> None:
    """Write that there is no answer for any view of a frame."""
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
    _normalise(points)


@inner
def _normalise(points: Float64) -> None:
    """Centre (P, 3) and bring it to root-mean-square radius 1."""
    count = len(points)
    squared = 0.0
    for i in range(3):
        mean = 0.0
        for p in range(count):
            mean += points[p, i] / count
        for p in range(count):
            points[p, i] -= mean
            squared += points[p, i] ** 2
    radius = math.sqrt(max(squared / count, TINY))
    for p in range(count):
        for i in range(3):
            points[p, i] /= radius


@inner
def _fill(
    seen: Float32, weights: Float32, points: Float64, guesses: Float64, filled: Float32
) -> bool:
    """Fill what is hidden in views that show something; False, and nothing done, if nothing is."""
    views, count, _ = seen.shape
    hidden = False
    for k in range(views):
        shown = total(weights[k])
        hidden = hidden or (0 < shown < count)
    if not hidden:
        return False
    rotation, shift = np.empty((3, 3)), np.empty(2)
    for k in range(views):
        scale = _solve_camera(points, seen[k], weights[k], guesses[k], rotation, shift)
        mean_x, mean_y = 0.0, 0.0
        for p in range(count):
            w = weights[k, p]
            x, y = _project(points[p], rotation, scale, shift)
            x, y = w * seen[k, p, 0] + (1 - w) * x, w * seen[k, p, 1] + (1 - w) * y
            filled[k, p, 0], filled[k, p, 1] = x, y
            mean_x += x / count
            mean_y += y / count
        squared = 0.0
        for p in range(count):
            filled[k, p, 0] -= mean_x
            filled[k, p, 1] -= mean_y
            squared += filled[k, p, 0] ** 2 + filled[k, p, 1] ** 2
        size = math.sqrt(max(squared / count, TINY))
        for p in range(count):
            filled[k, p, 0] /= size
            filled[k, p, 1] /= size
    return True


@inner
def _project(
    point: Float64, rotation: Float64, scale: float, shift: Float64
) -> tuple[float, float]:
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2]
    return scale * x + shift[0], scale * y + shift[1]


@inner
def _solve_camera(
    points: Float64,
    image: Float32,
    weights: Float32,
    guess: Float64,
    rotation: Float64,
    shift: Float64,
) -> float:
    """As `models.optics.weak_perspective.solve_cameras`, for one view; returns the scale."""
    count = len(points)
    summed = 0.0
    for p in range(count):
        summed += weights[p]
    summed = max(summed, TINY)
    mx, my, mz, mu, mv = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(count):
        w = weights[p] / summed
        mx += w * points[p, 0]
        my += w * points[p, 1]
        mz += w * points[p, 2]
        mu += w * image[p, 0]
        mv += w * image[p, 1]
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xu, yu, zu, xv, yv, zv, spread = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(count):
        w = weights[p] / summed
        x, y, z = points[p, 0] - mx, points[p, 1] - my, points[p, 2] - mz
        u, v = image[p, 0] - mu, image[p, 1] - mv
        xx += w * x * x
        xy += w * x * y
        xz += w * x * z
        yy += w * y * y
        yz += w * y * z
        zz += w * z * z
        xu += w * x * u
        yu += w * y * u
        zu += w * z * u
        xv += w * x * v
        yv += w * y * v
        zv += w * z * v
        spread += w * (u * u + v * v)
    variance = xx + yy + zz + TINY
    ridge = RIDGE * variance
    pull = ridge * math.sqrt(spread / variance + TINY)
    matrix, solved = np.empty((3, 3)), np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = xx + ridge, xy, xz
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = xy, yy + ridge, yz
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = xz, yz, zz + ridge
    inverse(matrix, solved)
    affine = np.empty((2, 3))
    for i in range(3):
        affine[0, i] = (
            solved[i, 0] * (xu + pull * guess[0, 0])
            + solved[i, 1] * (yu + pull * guess[0, 1])
            + solved[i, 2] * (zu + pull * guess[0, 2])
        )
        affine[1, i] = (
            solved[i, 0] * (xv + pull * guess[1, 0])
            + solved[i, 1] * (yv + pull * guess[1, 1])
            + solved[i, 2] * (zv + pull * guess[1, 2])
        )
    nearest_orthonormal_rows_into(affine, rotation)
    match, square = 0.0, 0.0
    for i in range(2):
        a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        match += (
            a * (xu if i == 0 else xv) + b * (yu if i == 0 else yv) + c * (zu if i == 0 else zv)
        )
        square += (
            a * (xx * a + xy * b + xz * c)
            + b * (xy * a + yy * b + yz * c)
            + c * (xz * a + yz * b + zz * c)
        )
    scale = match / (square + TINY)
    for i in range(2):
        shift[i] = (mu if i == 0 else mv) - scale * (
            rotation[i, 0] * mx + rotation[i, 1] * my + rotation[i, 2] * mz
        )
    return scale


@inner
def _mean_distance(
    points: Float64,
    image: Float32,
    weights: Float32,
    rotation: Float64,
    scale: float,
    shift: Float64,
) -> float:
    """Reprojection error of one view, mean over what was observed."""
    summed, seen = 0.0, 0
    for p in range(len(points)):
        if weights[p] > 0:
            x, y = _project(points[p], rotation, scale, shift)
            summed += math.sqrt((x - image[p, 0]) ** 2 + (y - image[p, 1]) ** 2)
            seen += 1
    return summed / max(seen, 1)


@inner
def _misfit(points: Float64, seen: Float32, weights: Float32, guesses: Float64) -> float:
    """Reprojection error of a frame in units of the structure, mean over what was observed."""
    rotation, shift = np.empty((3, 3)), np.empty(2)
    summed, number = 0.0, 0
    for k in range(len(seen)):
        observed = 0
        for p in range(len(points)):
            observed += weights[k, p] > 0
        if observed:
            scale = _solve_camera(points, seen[k], weights[k], guesses[k], rotation, shift)
            error = _mean_distance(points, seen[k], weights[k], rotation, scale, shift)
            summed += observed * error / max(scale, 1e-6)
            number += observed
    return summed / max(number, 1)


@inner
def _mirror(points: Float64, guesses: Float64) -> None:
    """Turn a structure into its mirror image through the x-y plane, which looks alike."""
    for p in range(len(points)):
        points[p, 2] = -points[p, 2]
    for k in range(len(guesses)):
        for i in range(2):
            guesses[k, i, 2] = -guesses[k, i, 2]
            guesses[k, 2, i] = -guesses[k, 2, i]


@inner
def _settle(
    points: Float64,
    seen: Float32,
    weights: Float32,
    guesses: Float64,
    foreshortening: float,
    other: Float64,
    rotations: Float64,
) -> None:
    """As `models.network.settling.settle`, for one frame, in place; the last two are scratch."""
    views = 0
    for k in range(len(seen)):
        views += total(weights[k]) > 0
    mirror = foreshortening < 0
    if views > 0:
        copy(points, other)
        error = _relax(points, seen, weights, guesses, foreshortening, rotations)
        if views > 1:
            turned = _relax(other, seen, weights, guesses, -foreshortening, rotations)
            if turned < DECISIVE * error:
                copy(other, points)
                mirror = not mirror
    if mirror:
        _mirror(points, guesses)
    _normalise(points)


@inner
def _relax(
    points: Float64, seen: Float32, weights: Float32, guesses: Float64, k: float, rotations: Float64
) -> float:
    """Alternate cameras and structure; the root of the summed squared errors."""
    views, count, _ = seen.shape
    target = np.empty((views, count, 2), np.float32)
    copy(seen, target)
    nearer = np.empty((views, count, 2))
    projected = np.empty((views, count, 2))
    scales, shift = np.empty(views), np.empty(2)
    normal, solved, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for round_ in range(ROUNDS + 1):
        squared = 0.0
        for v in range(views):
            scales[v] = _solve_camera(
                points, target[v], weights[v], guesses[v], rotations[v], shift
            )
            _first_order(
                points, weights[v], rotations[v], scales[v], shift, projected[v], nearer[v]
            )
            for p in range(count):
                for i in range(2):
                    target[v, p, i] = seen[v, p, i] - k * nearer[v, p, i]
                    residual = seen[v, p, i] - k * nearer[v, p, i] - projected[v, p, i]
                    squared += weights[v, p] * residual**2
        if round_ == ROUNDS:
            break
        for p in range(count):
            fill(normal, 0)
            fill(pull, 0)
            for i in range(3):
                normal[i, i] = STIFFNESS
            for v in range(views):
                w = weights[v, p] * scales[v]
                for axis in range(2):
                    residual = seen[v, p, axis] - k * nearer[v, p, axis] - projected[v, p, axis]
                    for i in range(3):
                        pull[i] += w * rotations[v, axis, i] * residual
                        for j in range(3):
                            normal[i, j] += (
                                w * scales[v] * rotations[v, axis, i] * rotations[v, axis, j]
                            )
            inverse(normal, solved)
            for i in range(3):
                points[p, i] += (
                    solved[i, 0] * pull[0] + solved[i, 1] * pull[1] + solved[i, 2] * pull[2]
                )
    return math.sqrt(squared)


@inner
def _first_order(
    points: Float64,
    weights: Float32,
    rotation: Float64,
    scale: float,
    shift: Float64,
    projected: Float64,
    nearer: Float64,
) -> None:
    """As `models.network.settling.first_order`, for one view."""
    count = len(points)
    summed = 0.0
    for p in range(count):
        summed += weights[p]
    summed = max(summed, 1e-6)
    z_mean, x_mean, y_mean = 0.0, 0.0, 0.0
    for p in range(count):
        x, y = _project(points[p], rotation, scale, shift)
        z = (
            rotation[2, 0] * points[p, 0]
            + rotation[2, 1] * points[p, 1]
            + rotation[2, 2] * points[p, 2]
        )
        projected[p, 0], projected[p, 1] = x, y
        nearer[p, 0] = z
        share = weights[p] / summed
        z_mean += share * z
        x_mean += share * x
        y_mean += share * y
    x_off, y_off = 0.0, 0.0
    for p in range(count):
        z = nearer[p, 0] - z_mean
        nearer[p, 0] = -z * (projected[p, 0] - x_mean)
        nearer[p, 1] = -z * (projected[p, 1] - y_mean)
        share = weights[p] / summed
        x_off += share * nearer[p, 0]
        y_off += share * nearer[p, 1]
    for p in range(count):
        nearer[p, 0] -= x_off
        nearer[p, 1] -= y_off
