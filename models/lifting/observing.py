"""Preparing frames for a lift: outliers are left out, and noise is removed."""

from collections import deque
from collections.abc import Sequence
from copy import copy
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.capture.fixed_lag import FixedLag
from models.capture.noise_removal import NoiseRemoval
from models.capture.observations import Observations, as_observations, join_frames
from models.capture.outliers import OutlierJudge, OutlierModel, nothing_left_out
from models.lifting.fitted_capture import FittedCapture
from models.settings.keypoints import check_confidence, check_keypoints

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

MOST_JUDGES = 64  # choices of views whose judges are kept at once


class ObservedFrames(NamedTuple):
    """N frames that are ready to be lifted."""

    observations: Observations
    outlier_probability: Float32 | None  # (N, K, P) as in `Answers`; None if nothing was judged
    views: tuple[int, ...] | None  # of the fit; None if they are cameras unknown to it
    # (N, K, P, 3): pixels and confidences of outliers. All 0 for other keypoints, and for frames
    # from which noise was removed: their keypoints no longer lie where they were seen.
    left_out: Float32
    # (N, K, P, 3): pixels before noise was removed from each frame on its own, and the inverse
    # variance of this noise, 0 where not observed. (0, K, P, 3) if no noise was removed so.
    detected: Float32
    smoothed: Bool  # (N,) whether noise was removed by smoothing in time

    def frames(self, chosen: slice | Bool) -> "ObservedFrames":
        """Return some of the frames."""
        judged = self.outlier_probability
        part = None if judged is None else judged[chosen]
        frames = self.observations.frames(chosen)
        detected = self.detected[chosen] if len(self.detected) else self.detected
        left_out, smoothed = self.left_out[chosen], self.smoothed[chosen]
        return ObservedFrames(frames, part, self.views, left_out, detected, smoothed)


def join_observed(parts: Sequence[ObservedFrames]) -> ObservedFrames:
    """Join frames of the same views and keypoints, seen by one prior."""
    if len(parts) == 1:
        return parts[0]
    judged = [part.outlier_probability for part in parts if part.outlier_probability is not None]
    return ObservedFrames(
        join_frames([part.observations for part in parts]),
        np.concatenate(judged) if judged else None,
        parts[0].views,
        np.concatenate([part.left_out for part in parts]),
        _join_detected(parts),
        np.concatenate([part.smoothed for part in parts]),
    )


def _as_seen(
    observations: Observations,
    probabilities: Float32 | None,
    views: tuple[int, ...] | None,
    left_out: Float32,
    *,
    smoothed: bool = False,
) -> ObservedFrames:
    """Return frames from which no noise was removed, or by smoothing in time."""
    in_time = np.full(len(left_out), smoothed)
    return ObservedFrames(observations, probabilities, views, left_out, left_out[:0], in_time)


def _join_detected(parts: Sequence[ObservedFrames]) -> Float32:
    if not any(len(part.detected) for part in parts):
        return parts[0].detected
    rows = [p.detected if len(p.detected) else np.zeros_like(p.left_out) for p in parts]
    return np.concatenate(rows)


class Observer:
    """Prepares frames for lifts with what a fit learnt of its keypoints.

    Immutable, and safe to use from several threads.
    """

    def __init__(
        self,
        capture: FittedCapture,
        outliers: OutlierModel | None,
        noise_removal: NoiseRemoval,
        views_of_rig: int,
    ) -> None:
        """`views_of_rig` is 0 if no cameras were estimated."""
        self._capture, self._removal = capture, noise_removal
        # Of those for rare choices of views the one used longest ago goes.
        self._judge_of = (
            None if outliers is None else lru_cache(MOST_JUDGES)(partial(OutlierJudge, outliers))
        )
        learnt = 0 if outliers is None else len(outliers.mean)
        self.views = learnt or noise_removal.views or views_of_rig  # of the fit; 0: nothing known

    def of(self, capture: FittedCapture) -> "Observer":
        """Return the same observer for another account of the capture."""
        other = copy(self)
        other._capture = capture
        return other

    def observe(
        self,
        keypoints: ArrayLike,
        confidence: ArrayLike | None,
        views: Sequence[int] | None,
        times: ArrayLike | None,
    ) -> ObservedFrames:
        """Prepare frames (N, K, P, 2) for a lift; parameters are those of `FittedPrior.lift`."""
        observed = self.judged(keypoints, confidence, views)
        if observed.views is None:
            return observed
        removed = self._removal.remove(observed.observations, observed.views, times)
        if removed is observed.observations:
            return observed
        return observed._replace(
            observations=removed,
            left_out=nothing_left_out(removed),
            detected=self._removal.detected(observed.observations, observed.views, times),
            smoothed=np.full(len(removed.weights), self._removal.smooths(times)),
        )

    def follow(self, views: Sequence[int] | None, lag: int) -> "Following":
        """Begin a film whose frames arrive one by one and are returned `lag` frames later."""
        chosen = self._views_of_fit(views, self.views if views is None else len(views)) or ()
        return Following(self, chosen, FixedLag(self._removal, chosen, lag))

    def judged(
        self, keypoints: ArrayLike, confidence: ArrayLike | None, views: Sequence[int] | None
    ) -> ObservedFrames:
        """Return the observations of the prior's keypoints, without outliers."""
        observations = self._of_capture(keypoints, confidence, views)
        chosen = self._views_of_fit(views, observations.weights.shape[1])
        if self._judge_of is None or chosen is None:
            return _as_seen(observations, None, chosen, nothing_left_out(observations))
        judged = self._judge_of(chosen).without_outliers(observations)
        return _as_seen(judged.observations, judged.probabilities, chosen, judged.left_out)

    def _of_capture(
        self,
        keypoints: ArrayLike,
        confidence: ArrayLike | None,
        views: Sequence[int] | None,
    ) -> Observations:
        if self._capture.whole:
            observations = as_observations(keypoints, confidence)
            self._check_count(observations.weights.shape[2])
            return observations
        pixels, weights = check_keypoints(keypoints), None
        self._check_count(pixels.shape[2])
        if confidence is not None:
            weights = check_confidence(confidence, expected=pixels.shape[:3])
        return as_observations(*self._capture.observations(pixels, weights, views))

    def _check_count(self, came: int) -> None:
        expected = len(self._capture.known)
        if came != expected:
            raise ValueError(
                f"this prior was fitted to {expected} keypoints per view,"
                f" got {came}; give them in the order of the fit, NaN for what was not observed"
            )

    def _views_of_fit(self, views: Sequence[int] | None, count: int) -> tuple[int, ...] | None:
        """Return which views of the fit the `count` views of a lift are; None if they are others.

        Raises ValueError if `views` does not name `count` different ones.
        """
        if views is None:
            return tuple(range(count)) if count == self.views else None
        different = len(views) == count == len(set(views))
        if not different or (self.views and not all(0 <= view < self.views for view in views)):
            raise ValueError(
                f"views must name {count} different views of the {self.views or 'unknown'} of the"
                f" fit, got {list(views)}"
            )
        return tuple(views) if self.views else None


class Following:
    """A film whose frames arrive one by one and are smoothed by those around them."""

    def __init__(self, observer: Observer, views: tuple[int, ...], smoother: FixedLag) -> None:
        """Begin with the first frame, of these views of the fit; see `Observer.follow`."""
        self._observer, self.views, self._smoother = observer, views, smoother
        self._judged: deque[Float32 | None] = deque()  # of the frames that wait

    def push(
        self, keypoints: ArrayLike, confidence: ArrayLike | None, time: float
    ) -> ObservedFrames | None:
        """Take the next frame, (1, K, P, 2) pixels; return the one that is `lag` before it, if any.

        Raises ValueError if it is malformed, or `time` in seconds is not after that of the last.
        """
        observed = self._observer.judged(keypoints, confidence, self.views)
        smoothed = self._smoother.push(observed.observations, time)
        self._judged.append(observed.outlier_probability)
        return self._with_probabilities(smoothed)

    def flush(self) -> ObservedFrames | None:
        """Return all frames that wait, if any; the next one begins another film."""
        return self._with_probabilities(self._smoother.flush())

    def _with_probabilities(self, observations: Observations | None) -> ObservedFrames | None:
        if observations is None:
            return None
        judged = [self._judged.popleft() for _ in range(len(observations.weights))]
        known = [one for one in judged if one is not None]
        probabilities = np.concatenate(known) if known else None
        left_out = nothing_left_out(observations)
        return _as_seen(observations, probabilities, self.views, left_out, smoothed=True)
