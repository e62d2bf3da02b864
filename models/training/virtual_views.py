"""Virtual views: projections of teachers into drawn cameras like those of the capture, compiled."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.numerics.compiled import compiled, inner
from models.numerics.matrices import product, total
from models.numerics.normalisation import normalise_view_into
from models.numerics.rotations import rotation_from_vector_into
from models.training.teachers import Teachers

Floats = NDArray[Any]  # of 32 or 64 bits

NEAREST = 0.2  # of the distance to the teacher's centre: no camera stands nearer to a keypoint
TILT = 0.1  # radians, standard deviation by which virtual cameras tilt and roll
DROPPING_SHARE = 0.5  # share of the frames that lose some of their views
LEAST_WEIGHT = 1e-6  # of a view: less would divide by zero
LEAST_SIZE = 1e-3  # of a view, in units of the teacher, whose radius is 1


class VirtualViews(NamedTuple):
    """V teachers and normalised views of them."""

    points: Tensor  # (V, P, 3)
    keypoints: Tensor  # (V, K, P, 2)
    weights: Tensor  # (V, K, P)


class _Teachers(NamedTuple):
    """What `models.training.teachers.Teachers` calls so, as arrays."""

    points: Floats  # (T, P, 3)
    rotations: Floats  # (T, K, 3, 3)
    observed: Floats  # (T, K)
    up_axes: Floats  # (T, 3)
    foreshortening: float
    noise: float


class _Views(NamedTuple):
    """The arrays of `VirtualViews`."""

    points: Floats
    keypoints: Floats
    weights: Floats


def virtual_views(
    teachers: Teachers, weights: Tensor, count: int, rng: np.random.Generator
) -> VirtualViews:
    """Draw `count` V teachers and views of them.

    Gaps are those of frames of the capture, whose `weights` (N, K, P) are given; half of the
    frames lose more views, so that priors learn to do with fewer than the capture mostly has.
    """
    _, views, keypoints = weights.shape
    drawn = VirtualViews(
        torch.empty(count, keypoints, 3),
        torch.empty(count, views, keypoints, 2),
        torch.empty(count, views, keypoints),
    )
    _draw_views(
        _Teachers(
            teachers.points.numpy(),
            teachers.rotations.numpy(),
            teachers.observed.numpy(),
            teachers.up_axes.numpy(),
            teachers.foreshortening,
            teachers.noise,
        ),
        weights.numpy(),
        rng.random((count, 4 + 3 * views)),
        rng.standard_normal((count, views, 3 + 2 * keypoints), np.float32),
        _Views(*(part.numpy() for part in drawn)),
    )
    return drawn


def drop_views(weights: Tensor, rng: np.random.Generator) -> Tensor:
    """Take views from half of the frames of `weights` (N, K, P); one of each is kept at least."""
    kept = torch.empty_like(weights)
    _drop_views(weights.numpy(), rng.random((len(weights), 2 + weights.shape[1])), kept.numpy())
    return kept


@compiled
def _drop_views(weights: Floats, uniform: Floats, out: Floats) -> None:
    for n in range(len(weights)):
        _drop_views_of_frame(weights[n], uniform[n], out[n])


@inner
def _drop_views_of_frame(weights: Floats, uniform: Floats, out: Floats) -> None:
    """Keep the views of one frame (K, P) that come first in a random order: one, or some, or all.

    `uniform` are 2 + K numbers in [0, 1): whether views are lost, how many, the order.
    """
    views, count = weights.shape
    observed = 0
    for k in range(views):
        observed += 1 if weights[k].any() else 0
    keep = 1 + int(uniform[1] * observed) if uniform[0] < DROPPING_SHARE else views
    for k in range(views):
        earlier = 0
        for j in range(views):
            if uniform[2 + j] < uniform[2 + k] and weights[j].any():
                earlier += 1
        for p in range(count):
            out[k, p] = weights[k, p] if earlier < keep else 0.0


@compiled
def _draw_views(
    teachers: _Teachers, weights: Floats, uniform: Floats, normal: Floats, out: _Views
) -> None:
    """Make virtual views `out` from random numbers.

    A row of `uniform` (V, 4 + 3 K), in [0, 1), chooses the frame whose gaps are used, the teacher,
    the views that are dropped (2 + K), the teacher's camera from which each view starts (K), and
    how far this camera moves around the teacher (K). A view of `normal` (V, K, 3 + 2 P) has the
    tilt of its camera and the noise of its keypoints.
    """
    views, count = weights.shape[1:]
    by_tilt, by_azimuth = np.empty((3, 3)), np.empty((3, 3))
    walked, r = np.empty((3, 3)), np.empty((3, 3))
    foreshortening, noise = teachers.foreshortening, teachers.noise
    for n in range(len(uniform)):
        drawn = uniform[n]
        gaps = weights[int(drawn[0] * len(weights))]  # (K, P)
        _drop_views_of_frame(gaps, drawn[2 : 4 + views], out.weights[n])
        teacher = int(drawn[1] * len(teachers.points))
        points, up = teachers.points[teacher], teachers.up_axes[teacher]
        out.points[n] = points
        for k in range(views):
            shown, image = out.weights[n, k], out.keypoints[n, k]  # (P,), (P, 2)
            if total(shown) <= 0.0:
                image[:] = 0
                continue
            # A camera that saw the teacher, walked round it: elevation and roll stay.
            camera = _nth_camera(teachers.observed[teacher], drawn[4 + views + k])
            azimuth = 2.0 * math.pi * drawn[4 + 2 * views + k]
            tilt = normal[n, k]
            rotation_from_vector_into(azimuth * up[0], azimuth * up[1], azimuth * up[2], by_azimuth)
            rotation_from_vector_into(TILT * tilt[0], TILT * tilt[1], TILT * tilt[2], by_tilt)
            product(teachers.rotations[teacher, camera], by_azimuth, walked)
            product(by_tilt, walked, r)
            for p in range(count):
                x, y, z = points[p, 0], points[p, 1], points[p, 2]
                # At unit scale a camera's distance is 1 / k: near things are larger.
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
                near = max(1.0 + foreshortening * depth, NEAREST)
                image[p, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) / near
                image[p, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) / near
                image[p, 0] += noise * tilt[3 + 2 * p]
                image[p, 1] += noise * tilt[4 + 2 * p]
            normalise_view_into(image, shown, LEAST_WEIGHT, LEAST_SIZE, image)


@inner
def _nth_camera(observed: Floats, uniform: float) -> int:
    """Return one of the views (K,) that were observed, chosen by a number in [0, 1)."""
    left = int(uniform * total(observed))
    for k in range(len(observed)):
        if observed[k] > 0:
            if left == 0:
                return k
            left -= 1
    return 0  # never reached: a teacher was seen by two views or more
