"""The images that keypoints come from: their sizes as given, or estimated from keypoints."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
ImageSizes = Sequence[tuple[int, int] | None]  # (width, height) in pixels

STRAY = 0.002  # share of the keypoints on either side that may lie astray, even outside the image
OUTSIDE = 0.02  # share of keypoints at negative coordinates from which the origin is no corner
EMPTY = (0.0, 1.0)  # least and most coordinate where there is no keypoint


class Images(NamedTuple):
    """The images of K views; pixels, in the keypoints' coordinates."""

    sizes: Float64  # (K, 2) width and height, given or estimated
    middles: Float64  # (K, 2) their middles
    known: Bool  # (K,) whether the user gave the size

    @property
    def side(self) -> float:
        """The longest side of all images."""
        return float(self.sizes.max())


def images_of(keypoints: Float64, weights: Float64, image_sizes: ImageSizes | None) -> Images:
    """Return the images as they were given, with one estimate for all views of unknown size.

    Coordinates (N, K, P, 2) count from the image's top-left corner, so an image is no smaller than
    the largest of them. Subjects keep as far from one side of the image as from the other, over
    all views: the least coordinate is the margin on both sides. The largest and smallest few of
    the keypoints (of positive weight, (N, K, P)) may be astray and do not count.
    """
    views = keypoints.shape[1]
    given = [None] * views if image_sizes is None else list(image_sizes)
    known = np.array([size is not None for size in given])
    guess, middle = _guess(keypoints[:, ~known], weights[:, ~known] > 0)
    sizes = np.array([guess if size is None else np.array(size, float) for size in given])
    return Images(sizes, np.where(known[:, None], sizes / 2, middle), known)


def _guess(keypoints: Float64, seen: Bool) -> tuple[Float64, Float64]:
    """Return size and middle (2,) of the images that all of these views have."""
    places = keypoints[seen]  # (n, 2)
    low, high = (np.full(2, bound) for bound in EMPTY)
    if len(places):
        low, high = np.quantile(places, (STRAY, 1 - STRAY), axis=0)
    if len(places) and (places < 0).mean() > OUTSIDE:  # the origin is elsewhere
        return np.asarray(high - low, np.float64), np.asarray(low + high, np.float64) / 2
    size: Float64 = low.clip(0) + high
    return size, size / 2
