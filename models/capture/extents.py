"""Where views show the subject and how large, whatever a few keypoints do."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.settings.keypoints import MIN_KEYPOINTS, MIN_SIZE

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


class Extents(NamedTuple):
    """Middles and radii of N frames of K views; NaN where a view shows too few keypoints.

    They are medians, of coordinates and of distances from the middle: a keypoint that was detected
    far away moves neither.
    """

    usable: Bool  # (N, K) views that show enough keypoints
    middles: Float32  # (N, K, 2) pixels
    radii: Float32  # (N, K) pixels
    usual_radii: Float64  # (K,) pixels, of the frames in which a view shows anything


def extents(pixels: Float32, seen: Bool) -> Extents:
    """Return the extents of keypoints (N, K, P, 2) in pixels, of which `seen` (N, K, P) count."""
    shown = np.where(seen[..., None], pixels, np.float32(np.nan))
    counts = seen.sum(2)  # (N, K)
    usable = counts >= MIN_KEYPOINTS
    middles = _medians(shown, counts[..., None], usable[..., None])
    radii = _medians(np.linalg.norm(shown - middles[:, :, None], axis=-1), counts, usable)
    usable &= radii > MIN_SIZE
    usual = [
        np.median(view[fine]) if fine.any() else np.nan
        for view, fine in zip(radii.T, usable.T, strict=True)
    ]
    return Extents(usable, middles, radii, np.array(usual))


def _medians(values: Float32, counts: NDArray[np.int64], usable: Bool) -> Float32:
    """Return medians over axis 2 of `counts` known values; NaN, which is not, is sorted last."""
    place = np.maximum(counts - 1, 0) // 2
    ordered = np.sort(values, axis=2)
    place = np.broadcast_to(np.expand_dims(place, 2), (*ordered.shape[:2], 1, *ordered.shape[3:]))
    medians = np.take_along_axis(ordered, place, axis=2).squeeze(2)
    return np.where(usable, medians, np.float32(np.nan))
