"""Which images a human should label first: those that would teach the detector most.

An image is a frame of a view. Its score is the number of keypoints that the detector got wrong or
missed there, each as far as the fit is sure of it and the detector was, and one more where the
subject's pose is unlike all others. From each burst of such images one is taken.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.labelling.accepted import FEWEST_OTHERS, Sizes, inside
from models.labelling.evidence import FAR, Evidence
from models.labelling.filmed import Filmed
from models.labelling.poses import are_alike, image_shapes, pose_distances
from models.settings.keypoints import OUTLIER

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
ReasonCode = Literal["outlier", "disagreement", "missed", "unlike_fit"]

LEAST_SCORE = 0.5  # of an image that is listed
# What a keypoint counts that was not detected in one frame, and in so many or more on end.
MISSED_ONCE, MISSED_FOR_LONG, LONG = 0.25, 0.75, 10
PLACELESS = 0.5  # times that, where it is not known where the camera looked
UNSURE = 0.25  # what counts of a wrong keypoint that the detector had no confidence in
NEAR = 2.0  # noises from the fit: an outlier that is not further off was detected rightly
APART = 15  # frames between two images of a view for the same reason, at least


class Reason(NamedTuple):
    """Why an image is worth labelling."""

    code: ReasonCode
    keypoints: tuple[int, ...]  # which it is about; none: all
    evidence: dict[str, float]


class Image(NamedTuple):
    """A frame of a view, what labelling it is worth, and why."""

    view: int
    frame: int  # of the view's own film
    moment: int | None  # the frame of the reconstruction that it shows, None if there is none
    score: float
    reasons: tuple[Reason, ...]


class Ranking(NamedTuple):
    """The images that are most worth labelling, best first, and how many are worth it at all."""

    images: tuple[Image, ...]
    candidates: int


class _Scores(NamedTuple):
    """What counts for each keypoint of each image, (N, K, P), and for poses (N, K)."""

    outlier: Float64
    disagreement: Float64
    missed: Float64
    unlike: Bool
    distances: Float64  # (N, K) how far a pose is from the others, in usual distances

    @property
    def total(self) -> Float64:
        return np.asarray((self.outlier + self.disagreement + self.missed).sum(-1) + self.unlike)

    @property
    def concerned(self) -> Bool:
        """What each image is about (N, K, 2 P + 1): keypoints wrong or missed, the whole pose."""
        wrong = (self.outlier > 0) | (self.disagreement > 0)
        return np.concatenate((wrong, self.missed > 0, self.unlike[..., None]), axis=-1)


def rank(
    filmed: Filmed, evidence: Evidence, sizes: Sizes, *, most: int, apart: int = APART
) -> Ranking:
    """Return the images that are most worth labelling.

    Parameters
    ----------
    sizes
        (width, height) of the images of each view, None where unknown.
    most
        How many to return at most.
    apart
        Frames between two images of a view for the same reason, at least. Further away they are
        left out, too, if they look alike.
    """
    scores = _scores(filmed, evidence, sizes)
    total, concerned = scores.total, scores.concerned
    shapes = image_shapes(filmed.reprojections)
    left = np.where(total >= LEAST_SCORE, total, 0.0)
    candidates = int(np.count_nonzero(left))
    every = np.arange(len(left))
    only_unlike = scores.unlike & ~concerned[..., :-1].any(-1)
    images: list[Image] = []
    while len(images) < most:
        frame, view = (int(index) for index in np.unravel_index(left.argmax(), left.shape))
        if left[frame, view] == 0:
            break
        images.append(_described(filmed, evidence, scores, frame, view))
        left[frame, view] = 0
        near = np.abs(every - frame) < apart
        of_same = (concerned[:, view] & concerned[frame, view]).any(-1) & (left[:, view] > 0)
        others = np.flatnonzero(of_same & ~near)
        left[of_same & near, view] = 0
        left[others[are_alike(shapes[others, view], shapes[frame, view])], view] = 0
        if scores.unlike[frame, view]:  # the same pose from elsewhere
            same = np.abs(filmed.moments - filmed.moments[frame, view]) < apart
            left[only_unlike & same] = 0
    return Ranking(tuple(images), candidates)


def _scores(filmed: Filmed, evidence: Evidence, sizes: Sizes) -> _Scores:
    detected = np.asarray(np.isfinite(filmed.keypoints[..., 0]))
    doubt = np.nan_to_num(filmed.outlier_probability)
    with np.errstate(invalid="ignore", divide="ignore"):
        outlying = detected & (doubt > OUTLIER) & ~(evidence.deviations < NEAR)
        off = 1 - np.square(FAR / evidence.deviations)
    far = detected & ~outlying & (off > 0)
    trust = UNSURE + (1 - UNSURE) * filmed.confidence
    distances = pose_distances(filmed.structures, APART)
    poses = np.repeat(distances.ratios[:, None], detected.shape[1], axis=1)
    unlike = np.repeat((filmed.unlike | distances.unlike)[:, None], detected.shape[1], axis=1)
    return _Scores(
        outlier=np.where(outlying, trust * doubt, 0.0),
        disagreement=np.where(far, trust * off, 0.0),
        missed=_missed(filmed, evidence, sizes, detected),
        unlike=filmed.of_moments(unlike),
        distances=filmed.of_moments(poses),
    )


def _missed(filmed: Filmed, evidence: Evidence, sizes: Sizes, detected: Bool) -> Float64:
    """Return what counts (N, K, P) where the view did not detect what others see well."""
    views = detected.shape[1]
    sure = evidence.others >= min(FEWEST_OTHERS, max(views - 1, 1))
    sure &= ~detected & evidence.accepted.any(0)  # a view may never show a keypoint
    placed = np.asarray(np.isfinite(filmed.reprojections).all(-1))
    shown = _within_reach(filmed, evidence, sizes)
    # Of a camera that moves, it is not known where it looked; shortly before or after, it saw.
    nearby = _spread_out(np.asarray(detected.any(-1)), APART)[..., None]
    weight = np.where(placed, shown * 1.0, PLACELESS * nearby)
    grown = np.clip((_lengths(sure) - 1) / (LONG - 1), 0, 1)
    weight *= MISSED_ONCE + (MISSED_FOR_LONG - MISSED_ONCE) * grown
    return np.where(sure, weight * (1 - np.exp2(-evidence.others.astype(np.float64))), 0.0)


def _lengths(there: Bool) -> NDArray[np.int64]:
    """Return how many frames on end (N, K, P) something is there; 0 where it is not."""
    every = np.arange(len(there))[:, None, None]
    before = np.maximum.accumulate(np.where(there, -1, every), axis=0)
    after = np.minimum.accumulate(np.where(there, len(there), every)[::-1], axis=0)[::-1]
    return np.where(there, after - before - 1, 0)


def _within_reach(filmed: Filmed, evidence: Evidence, sizes: Sizes) -> Bool:
    """Return which reprojections (N, K, P) are in the image, or where the view saw anything."""
    within = inside(filmed.reprojections, sizes)
    for view, size in enumerate(sizes):
        seen = filmed.keypoints[:, view][evidence.accepted[:, view]]
        if size is None and len(seen):
            pixels = filmed.reprojections[:, view]
            with np.errstate(invalid="ignore"):
                within[:, view] = ((pixels >= seen.min(0)) & (pixels <= seen.max(0))).all(-1)
    return within


def _spread_out(there: Bool, reach: int) -> Bool:
    """Return which frames (N, K) have one that is there within `reach` frames."""
    counts = np.concatenate((np.zeros((1, there.shape[1]), np.int64), there.cumsum(0)))
    every = np.arange(len(there))
    first, last = np.maximum(every - reach, 0), np.minimum(every + reach + 1, len(there))
    return np.asarray(counts[last] > counts[first])


def _described(filmed: Filmed, evidence: Evidence, scores: _Scores, frame: int, view: int) -> Image:
    """Return an image with its reasons, those that count most first."""
    at = (frame, view)
    doubt, errors = filmed.outlier_probability[at], evidence.errors[at]
    reasons: list[tuple[float, Reason]] = []

    def add(code: ReasonCode, counted: Float64, **known: Float64) -> None:
        which = np.flatnonzero(counted > 0)
        if len(which):
            numbers = {name: values[which] for name, values in known.items()}
            found = {
                name: round(float(values[np.isfinite(values)].max()), 3)
                for name, values in numbers.items()
                if np.isfinite(values).any()
            }
            reason = Reason(code, tuple(which.tolist()), found)
            reasons.append((float(counted.sum()), reason))

    add("outlier", scores.outlier[at], error_px=errors, probability=doubt)
    noises = errors / evidence.noise[view]
    add("disagreement", scores.disagreement[at], error_px=errors, noises=noises)
    add("missed", scores.missed[at], views=evidence.others[at].astype(np.float64))
    if scores.unlike[at]:
        far = float(scores.distances[at])
        numbers = {"distance_ratio": round(far, 3)} if np.isfinite(far) else {}
        reasons.append((1.0, Reason("unlike_fit", (), numbers)))
    moment = filmed.moments[at]
    return Image(
        view,
        frame,
        int(np.rint(moment)) if np.isfinite(moment) else None,
        round(sum(counted for counted, _ in reasons), 3),
        tuple(reason for _, reason in sorted(reasons, key=lambda one: -one[0])),
    )
