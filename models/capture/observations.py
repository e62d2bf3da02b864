"""Bringing every view of 2D keypoints to the same position and size."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.numerics.compiled import compiled
from models.numerics.matrices import fill
from models.numerics.normalisation import normalise_view_into
from models.settings.keypoints import (
    MIN_CONFIDENCE,
    MIN_KEYPOINTS,
    MIN_SIZE,
    Float32,
    check_confidence,
    check_keypoints,
)


class Observations(NamedTuple):
    """Keypoints ready for the prior: every usable view centred, with root-mean-square radius 1.

    `keypoints * sizes + centres` gives back the pixels. Whatever was not observed, or lies in a
    view that is not usable, is 0 with weight 0.
    """

    keypoints: Float32  # (N, K, P, 2) unitless
    weights: Float32  # (N, K, P) in [0, 1]
    centres: Float32  # (N, K, 2) pixels
    sizes: Float32  # (N, K) pixels
    usable: NDArray[np.bool_]  # (N, K) at least MIN_KEYPOINTS keypoints that do not coincide

    def frames(self, chosen: slice | NDArray[np.bool_]) -> "Observations":
        """Return some of the frames."""
        keypoints, weights, centres, sizes, usable = self
        return Observations(
            keypoints[chosen], weights[chosen], centres[chosen], sizes[chosen], usable[chosen]
        )


def join_frames(parts: Sequence[Observations]) -> Observations:
    """Join observations of the same views and keypoints, frame after frame."""
    return Observations._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def with_frames(
    observations: Observations, chosen: NDArray[np.bool_], others: Observations
) -> Observations:
    """Return observations with the frames `chosen` (N,) replaced by `others`."""
    changed = Observations._make(array.copy() for array in observations)
    for array, other in zip(changed, others, strict=True):
        array[chosen] = other
    return changed


def pixels_of(observations: Observations) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return keypoints (N, K, P, 2) in pixels, and whether they were observed (N, K, P)."""
    sizes, centres = observations.sizes, observations.centres
    pixels = observations.keypoints * sizes[..., None, None] + centres[..., None, :]
    return pixels.astype(np.float64), observations.weights > 0


def as_observations(keypoints: ArrayLike, confidence: ArrayLike | None = None) -> Observations:
    """Check `keypoints` (N, K, P, 2) in pixels and normalise every view by what it shows.

    A keypoint with a NaN coordinate, or with confidence (N, K, P) under 0.001 or NaN, counts as
    not observed; other confidences weight it. The centre of a view is the weighted mean of its
    keypoints, its size the weighted root mean square of their distances to it.

    Raises
    ------
    ValueError
        Wrong shape, infinite or absurd coordinates, confidence outside [0, 1]. The message states
        what was expected, what came, and how to mend it.
    """
    pixels = check_keypoints(keypoints)
    pixels = np.ascontiguousarray(pixels)
    # NaN in either coordinate is NaN in their sum.
    weights = np.isfinite(pixels[..., 0] + pixels[..., 1]).astype(np.float32)
    if confidence is not None:
        weights *= check_confidence(confidence, expected=pixels.shape[:3])
    seen = Observations(
        np.empty(pixels.shape, np.float32),
        weights,
        np.empty((*weights.shape[:2], 2), np.float32),
        np.empty(weights.shape[:2], np.float32),
        np.empty(weights.shape[:2], np.bool_),
    )
    _normalise_views(pixels, seen)
    return seen


@compiled
def _normalise_views(pixels: Float32, seen: Observations) -> None:
    """Write all but the weights, and 0 to the weights of views that are not usable."""
    frames, views, count, _ = pixels.shape
    for n in range(frames):
        for k in range(views):
            weights, out = seen.weights[n, k], seen.keypoints[n, k]  # (P,), (P, 2)
            shown = 0
            for p in range(count):
                shown += weights[p] > 0
            placed = normalise_view_into(pixels[n, k], weights, MIN_CONFIDENCE, MIN_SIZE, out)
            usable = shown >= MIN_KEYPOINTS and placed.size > MIN_SIZE
            seen.centres[n, k, 0], seen.centres[n, k, 1] = placed.x, placed.y
            seen.sizes[n, k] = placed.size if usable else 1
            seen.usable[n, k] = usable
            if not usable:
                fill(out, 0)
                fill(weights, 0)
