"""The keypoints that a fit accepts, as labels to train a detector on, with weights."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.labelling.evidence import FAR, Evidence
from models.labelling.filmed import Filmed

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Source = Literal["reprojections", "keypoints"]
Sizes = list[tuple[int, int] | None]

FEWEST_OTHERS = 2  # views that fix a point without the view that is to be labelled
DIGITS = 3  # of a pixel


class Accepted(NamedTuple):
    """Labels of N frames of K views of P keypoints, the frames being the views' own."""

    keypoints: Float64  # (N, K, P, 2) pixels, NaN where there is no label
    weights: Float64  # (N, K, P) in [0, 1], 0 where there is no label
    detected: Bool  # (N, K, P) labels whose keypoint the view itself detected rightly


def accept(
    filmed: Filmed,
    evidence: Evidence,
    sizes: Sizes,
    source: Source,
    corrected: Bool | None = None,
) -> Accepted:
    """Return the accepted keypoints of all frames.

    The weight is `(1 - p) (1 - 2^-s) / (1 + (d / 4)^2)`: p is the probability that the view's own
    keypoint is an outlier, s the number of views that agree on the keypoint, d the distance of
    detections from the fit in noise: the view's own for detections, and of all that agree, root
    mean square, for reprojections.

    Parameters
    ----------
    sizes
        (width, height) of the images of each view, None where unknown: a reprojection outside of
        its image is no label.
    source
        Reprojections are where the fit shows a keypoint, if the view itself or two others saw it;
        keypoints are those of the detector that the fit agrees with.
    corrected
        (N, K, P) keypoints that a human put right or removed: whatever the fit makes of them, they
        are labels of weight 1 as they are, if their place is inside the image, or none.
    """
    own = evidence.accepted
    if source == "keypoints":
        there, places, apart = own, filmed.keypoints, evidence.deviations
    else:
        there = own | (evidence.others >= FEWEST_OTHERS)
        there &= np.isfinite(filmed.reprojections).all(-1) & inside(filmed.reprojections, sizes)
        places, apart = filmed.reprojections, evidence.spread
    doubt = np.where(own, np.nan_to_num(filmed.outlier_probability), 0.0)
    support = 1 - np.exp2(-(evidence.others + own).astype(np.float64))
    with np.errstate(invalid="ignore"):
        weights = (1 - doubt) * support / (1 + np.square(apart / FAR))
    if corrected is not None:
        seen = np.isfinite(filmed.keypoints).all(-1) & inside(filmed.keypoints, sizes)
        there = np.where(corrected, seen, there)
        own = own | corrected
        places = np.where(corrected[..., None], filmed.keypoints, places)
        weights = np.where(corrected, 1.0, weights)
    return Accepted(
        keypoints=_rounded(np.where(there[..., None], places, np.nan)),
        weights=_rounded(np.where(there, weights, 0.0)),
        detected=there & own,
    )


def _rounded(values: Float64) -> Float64:
    return np.asarray(np.round(values, DIGITS), np.float64)


def inside(pixels: Float64, sizes: Sizes) -> Bool:
    """Return which pixels (N, K, P, 2) lie in their images; all of views of unknown size."""
    within = np.ones(pixels.shape[:3], np.bool_)
    for view, size in enumerate(sizes):
        if size is not None:
            with np.errstate(invalid="ignore"):
                shown = (pixels[:, view] >= 0) & (pixels[:, view] <= np.array(size) - 1)
            within[:, view] = shown.all(-1)
    return within
