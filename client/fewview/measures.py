"""Lengths, angles and ratios of structures, with how far they may be off.

Deviations are to first order: `J Sigma J^T`, with the derivatives J of a measure by its points, and
their covariance `Sigma = blockdiag(C - U U^T) + U U^T`.
"""

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewview.geometry.placing import FULL

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Array = NDArray[Any]


class Measured(NamedTuple):
    """M measures in N frames.

    Attributes
    ----------
    values
        (N, M), NaN where a point has no answer.
    sds
        (N, M) their standard deviations, in the unit of the values; NaN where they are not known.
    """

    values: Float64
    sds: Float64


class Uncertain(NamedTuple):
    """Points (N, P, 3), their covariances (N, P, 6) and modes (N, P, 3, r); see `fewview.Lift`."""

    points: Float32
    covariances: Float32 | None
    modes: Float32 | None


# From points (N, k, 3) to a measure (N,) and its derivatives (N, k, 3).
_Measure = Callable[[Float64], tuple[Float64, Float64]]


def lengths(of: Uncertain, pairs: ArrayLike) -> Measured:
    """Return the distances of pairs (M, 2) of keypoints."""
    return _measured(of, _indices(pairs, (2,), "pairs", of), _length)


def angles(of: Uncertain, triples: ArrayLike) -> Measured:
    """Return the angles of triples (M, 3) of keypoints at the second of them, degrees."""
    return _measured(of, _indices(triples, (3,), "triples", of), _angle)


def ratios(of: Uncertain, pairs: ArrayLike) -> Measured:
    """Return the length of the first of two pairs (M, 2, 2) by that of the second."""
    return _measured(of, _indices(pairs, (2, 2), "pairs", of), _ratio)


def _indices(given: ArrayLike, shape: tuple[int, ...], name: str, of: Uncertain) -> Array:
    """Return the keypoints (M, k) of M measures.

    Raises
    ------
    ValueError
        If they are not of this shape, not keypoints, or the same where they must differ.
    """
    found, count = np.asarray(given), of.points.shape[1]
    if found.shape[1:] != shape or found.dtype.kind not in "iu":
        wanted = " of ".join(["pairs"] * (len(shape) - 1) + [f"{shape[-1]} keypoints"])
        raise ValueError(
            f"{name}: expected a list of {wanted} each, by their numbers from 0, got {given!r:.100}"
        )
    if found.size and not (found.min() >= 0 and found.max() < count):
        wrong = found.max() if found.max() >= count else found.min()
        raise ValueError(f"{name}: expected keypoints 0 to {count - 1}, got {wrong}")
    rows = found.reshape(-1, shape[-1])
    same = np.diff(np.sort(rows, axis=1), axis=1) == 0
    if same.any():
        wrong = rows[same.any(1)][0].tolist()
        raise ValueError(f"{name}: expected keypoints that differ, got {wrong}")
    return found.reshape(len(found), prod(shape))


def _measured(of: Uncertain, measures: Array, measure: _Measure) -> Measured:
    values, sds = np.full((2, len(of.points), len(measures)), np.nan)
    for number, chosen in enumerate(measures):
        with np.errstate(invalid="ignore", divide="ignore"):
            values[:, number], slopes = measure(of.points[:, chosen].astype(np.float64))
        if of.covariances is not None and of.modes is not None:
            sds[:, number] = _deviations(of.covariances, of.modes, chosen, slopes)
    return Measured(values, sds)


def _deviations(covariances: Float32, modes: Float32, chosen: Array, slopes: Float64) -> Float64:
    """Return the standard deviations (N,) of a measure by its slopes (N, k, 3) along k points."""
    points, places = np.unique(chosen, return_inverse=True)  # a ratio may have a point twice
    total = np.zeros((len(slopes), len(points), 3))
    for place, point in enumerate(places):
        total[:, point] += slopes[:, place]
    blocks = covariances[:, points].astype(np.float64)[..., FULL]
    along = np.einsum("npi,npir->npr", total, modes[:, points].astype(np.float64))
    own = np.einsum("npi,npij,npj->n", total, blocks, total) - np.square(along).sum((1, 2))
    shared = np.square(along.sum(1)).sum(1)
    return np.asarray(np.sqrt(np.maximum(own, 0) + shared))


def _length(points: Float64) -> tuple[Float64, Float64]:
    way = points[:, 0] - points[:, 1]
    length = np.linalg.norm(way, axis=1)
    direction = way / length[:, None]
    return length, np.stack((direction, -direction), axis=1)


def _angle(points: Float64) -> tuple[Float64, Float64]:
    arms = points[:, [0, 2]] - points[:, 1:2]
    sizes = np.linalg.norm(arms, axis=2, keepdims=True)
    directions = arms / sizes
    first, second = directions[:, 0], directions[:, 1]
    cosine = np.sum(first * second, axis=1)
    angle = np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), cosine)
    # The end of an arm widens the angle as it moves away from the other, across its own.
    away = cosine[:, None, None] * directions - directions[:, ::-1]
    away /= np.linalg.norm(away, axis=2, keepdims=True) * sizes
    slopes = np.stack((away[:, 0], -away.sum(1), away[:, 1]), axis=1)
    return np.degrees(angle), np.degrees(slopes)


def _ratio(points: Float64) -> tuple[Float64, Float64]:
    (above, up), (below, down) = _length(points[:, :2]), _length(points[:, 2:])
    ratio = above / below
    slopes = np.concatenate((up / above[:, None, None], -down / below[:, None, None]), axis=1)
    return ratio, ratio[:, None, None] * slopes
