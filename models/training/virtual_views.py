"""Virtual views: teachers seen by made-up cameras like those of the capture, compiled."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.numerics.compiled import compiled
from models.numerics.matrices import product, total
from models.numerics.rotations import rotation_from_vector_into
from models.training.teachers import Teachers

Floats = NDArray[Any]  # of 32 or 64 bits

NEAREST = 0.2  # of the distance to the teacher's centre: no camera stands nearer to a keypoint
TILT = 0.1  # radians, standard deviation by which virtual cameras tilt and roll
FEWER = 0.5  # share of the frames that lose some of their views
LEAST = 1e-6


def virtual_views(
    teachers: Teachers, weights: Tensor, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw `count` teachers (V, P, 3) and normalised views of them: (V, K, P, 2) and (V, K, P).

    Gaps are those of frames of the capture, whose `weights` (N, K, P) are given; half of the
    frames lose more views, so that priors learn to do with fewer than the capture mostly has.
    """
    _, views, keypoints = weights.shape
    points = torch.empty(count, keypoints, 3)
    seen, shown = torch.empty(count, views, keypoints, 2), torch.empty(count, views, keypoints)
    _virtual_views(
        teachers.points.numpy(),
        teachers.rotations.numpy(),
        teachers.seen.numpy(),
        teachers.ups.numpy(),
        teachers.foreshortening,
        teachers.noise,
        weights.numpy(),
        rng.random((count, 4 + 3 * views)),
        rng.standard_normal((count, views, 3 + 2 * keypoints), np.float32),
        points.numpy(),
        seen.numpy(),
        shown.numpy(),
    )
    return points, seen, shown


def drop_views(weights: Tensor, rng: np.random.Generator) -> Tensor:
    """Take views from half of the frames of `weights` (N, K, P); one of each is kept at least."""
    kept = torch.empty_like(weights)
    _drop_views(weights.numpy(), rng.random((len(weights), 2 + weights.shape[1])), kept.numpy())
    return kept


@compiled
def _drop_views(weights: Floats, drawn: Floats, out: Floats) -> None:
    for n in range(len(weights)):
        _drop(weights[n], drawn[n], out[n])


@compiled
def _drop(weights: Floats, drawn: Floats, out: Floats) -> None:
    """Keep the views of one frame (K, P) that come first in a random order: one, or some, or all.

    `drawn` are 2 + K numbers in [0, 1): whether views are lost, how many, the order.
    """
    views, count = weights.shape
    there = 0
    for k in range(views):
        there += 1 if weights[k].any() else 0
    keep = 1 + int(drawn[1] * there) if drawn[0] < FEWER else views
    for k in range(views):
        before = 0
        for j in range(views):
            if drawn[2 + j] < drawn[2 + k] and weights[j].any():
                before += 1
        for p in range(count):
            out[k, p] = weights[k, p] if before < keep else 0.0


@compiled
def _virtual_views(
    teachers: Floats,
    rotations: Floats,
    seen: Floats,
    ups: Floats,
    foreshortening: float,
    noise: float,
    weights: Floats,
    uniform: Floats,
    normal: Floats,
    out_points: Floats,
    out_keypoints: Floats,
    out_weights: Floats,
) -> None:
    views, count = weights.shape[1:]
    by_tilt, by_azimuth = np.empty((3, 3)), np.empty((3, 3))
    walked, r = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(uniform)):
        drawn = uniform[n]
        _drop(weights[int(drawn[0] * len(weights))], drawn[2 : 4 + views], out_weights[n])
        teacher = int(drawn[1] * len(teachers))
        points, up = teachers[teacher], ups[teacher]
        out_points[n] = points
        for k in range(views):
            whole = total(out_weights[n, k])
            if whole <= 0.0:
                out_keypoints[n, k] = 0
                continue
            # A camera that saw the teacher, walked round it: elevation and roll stay.
            camera = int(drawn[4 + views + k] * total(seen[teacher]))
            for j in range(views):
                if seen[teacher, j] > 0:
                    if camera == 0:
                        camera = j
                        break
                    camera -= 1
            azimuth = 2.0 * math.pi * drawn[4 + 2 * views + k]
            tilt = normal[n, k]
            rotation_from_vector_into(azimuth * up[0], azimuth * up[1], azimuth * up[2], by_azimuth)
            rotation_from_vector_into(TILT * tilt[0], TILT * tilt[1], TILT * tilt[2], by_tilt)
            product(rotations[teacher, camera], by_azimuth, walked)
            product(by_tilt, walked, r)
            u = v = 0.0
            image = out_keypoints[n, k]
            for p in range(count):
                x, y, z = points[p, 0], points[p, 1], points[p, 2]
                # At unit scale a camera's distance is 1 / k: near things are larger.
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
                near = max(1.0 + foreshortening * depth, NEAREST)
                image[p, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) / near
                image[p, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) / near
                image[p, 0] += noise * tilt[3 + 2 * p]
                image[p, 1] += noise * tilt[4 + 2 * p]
                u += out_weights[n, k, p] * image[p, 0]
                v += out_weights[n, k, p] * image[p, 1]
            _normalise(image, out_weights[n, k], max(whole, LEAST), u, v)


@compiled
def _normalise(image: Floats, weights: Floats, whole: float, u: float, v: float) -> None:
    """Bring a view (P, 2) with weighted sums u, v to place and size as `as_observations` does."""
    squares = 0.0
    for p in range(len(image)):
        image[p, 0] -= u / whole
        image[p, 1] -= v / whole
        squares += weights[p] * (float(image[p, 0]) ** 2 + float(image[p, 1]) ** 2)
    size = math.sqrt(max(squares / whole, LEAST))
    for p in range(len(image)):
        for d in range(2):
            image[p, d] = image[p, d] / size if weights[p] > 0 else 0.0
