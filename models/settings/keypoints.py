"""Checking 2D keypoints. Imports nothing but NumPy, so that a store or an API can check cheaply."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

MIN_KEYPOINTS = 4  # three fix a weak-perspective camera; the fourth has information on the shape
MAX_KEYPOINTS = 1024
MAX_VIEWS = 64
MAX_COORDINATE = 1e6  # pixels; far beyond any sensor, and safe to square in float32
MIN_CONFIDENCE = 1e-3  # below this a keypoint counts as not observed
OUTLIER = 0.5  # probability of being an outlier above which a keypoint is left out
MIN_SIZE = 1e-3  # pixels; a view whose keypoints all coincide shows no shape

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]


def check_keypoints(keypoints: ArrayLike) -> Float32:
    """Return `keypoints` as float32 of shape (N, K, P, 2), or raise ValueError with the reason."""
    try:
        pixels = np.asarray(keypoints, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise ValueError(
            "keypoints must be an array of numbers of shape (frames, views, keypoints, 2);"
            " write NaN for what was not observed and give every frame the same number of views"
        ) from error
    if pixels.ndim != 4 or pixels.shape[-1] != 2:
        raise ValueError(
            f"keypoints must have shape (frames, views, keypoints, 2), got {pixels.shape};"
            " a single frame is keypoints[None], a single view keypoints[:, None]"
        )
    _, views, count, _ = pixels.shape
    if not 1 <= views <= MAX_VIEWS:
        raise ValueError(f"keypoints must have 1 to {MAX_VIEWS} views, got {views}")
    if count < MIN_KEYPOINTS:
        raise ValueError(f"expected at least {MIN_KEYPOINTS} keypoints per view, got {count}")
    if count > MAX_KEYPOINTS:
        raise ValueError(f"expected at most {MAX_KEYPOINTS} keypoints per view, got {count}")
    # fmax skips NaN, which is how a missing keypoint is written; infinity is not.
    largest = np.fmax.reduce(pixels, axis=None, initial=0)
    largest = max(largest, -np.fmin.reduce(pixels, axis=None, initial=0))  # without a copy of all
    if not largest <= MAX_COORDINATE:
        raise ValueError(
            f"keypoints must lie within {MAX_COORDINATE:g} pixels of the origin,"
            f" got {largest:g}; write NaN for what was not observed"
        )
    return pixels


def check_confidence(confidence: ArrayLike, *, expected: tuple[int, ...]) -> Float32:
    """Return `confidence` as float32 of shape (N, K, P), 0 where it is NaN or under 0.001.

    Raises ValueError when the shape is not `expected` or a value lies outside [0, 1].
    """
    values = np.asarray(confidence, dtype=np.float32)
    if values.shape != expected:
        raise ValueError(
            f"confidence must have shape (frames, views, keypoints) = {expected},"
            f" got {values.shape}"
        )
    values = np.nan_to_num(values, nan=0.0)
    if values.size and (values.min() < 0 or values.max() > 1):
        raise ValueError(
            f"confidence must lie in [0, 1], got {values.min():g} to {values.max():g};"
            " clip values a little above 1; if they go far beyond, divide all by the highest"
        )
    return np.where(values < MIN_CONFIDENCE, np.float32(0), values)


def check_edges(edges: ArrayLike | None, keypoints: int) -> Int64:
    """Return the pairs (E, 2) of so many keypoints that are joined, each once; none for None.

    Raises ValueError unless each names two different ones.
    """
    pairs = np.asarray([] if edges is None else edges)
    if not pairs.size:
        return np.zeros((0, 2), np.int64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        raise ValueError(
            f"edges must be pairs of keypoint indices, (edges, 2), got {pairs.dtype} of shape"
            f" {pairs.shape}"
        )
    for a, b in pairs.tolist():
        if a == b or min(a, b) < 0 or max(a, b) >= keypoints:
            raise ValueError(
                f"edges must name two different keypoints from 0 to {keypoints - 1}, got [{a}, {b}]"
            )
    return np.unique(np.sort(pairs.astype(np.int64), axis=1), axis=0)
