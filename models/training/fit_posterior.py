"""The posterior of a fit, learnt from its frames at the end."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.bundle.problem import Rig
from models.calibrating.result import SelfCalibration
from models.capture.observations import Observations, pixels_of
from models.findings.advice import attempt
from models.lifting.deviations import as_lifted
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.posterior.answers import frames_as_detected
from models.posterior.frames import Frames
from models.posterior.learning import learn_posterior
from models.posterior.posterior import Posterior
from models.posterior.quality import USUAL_SHARE
from models.posterior.responses import (
    STEP,
    corrections_where_hidden,
    hide_some,
    repetition,
    response_of,
    white_steps,
)
from models.training.batches import Data, enough_frames

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MOST_FRAMES = 300  # that it is learnt from
FEWEST_UNSEEN = 20  # frames that the network did not learn from, to learn from these alone


def posterior_of(
    found: SelfCalibration,
    prior: FittedPrior,
    data: Data,
    detected: Data,
    frames: Tensor,
    shares_left: tuple[float, float],
) -> Posterior | None:
    """Learn how far answers may be off from some of `frames` (T,), which two views or more show.

    None if keypoints locate points in too few of them. `detected` is the data before noise was
    removed, and `shares_left` are as in `learn_posterior`.
    """
    count = min(enough_frames(*data.weights.shape[1:], most=MOST_FRAMES), len(frames))
    some = frames[torch.linspace(0, len(frames) - 1, count).long()]
    weights = data.weights[some]
    lift = prior.lift(data.pixels(some), confidence=weights, refine="full", uncertainty="off")
    there: Bool = np.all(np.isfinite(lift.points3d), axis=(1, 2))
    there = np.logical_and(there, np.any(lift.camera_models > 0, axis=1))
    return learn_posterior(
        lift.frames(there),
        found.rig,
        found.shapes.mean,
        detected.pixels(some).double().numpy()[there],
        weights.double().numpy()[there],
        found.deviations,
        shares_left=shares_left,
    )


def with_posterior(
    prior: FittedPrior,
    posterior: Posterior | None,
    detected: Observations,
    times: Float64 | None,
    held_out: Int64,
) -> FittedPrior:
    """Return a finished prior with its posterior, corrected by what its lifts do.

    `detected` are the keypoints of the fit, with no noise removed, and `times` (N,) or (N, K) those
    of its frames, in seconds. The network did not learn from frames `held_out`.
    """
    if posterior is None or prior.self_calibration is None:
        return prior
    lifts = _Lifts(prior, posterior, prior.self_calibration.rig)
    count, uncorrected = len(detected.weights), posterior.corrections[0]
    most = enough_frames(*detected.weights.shape[1:], most=MOST_FRAMES)
    every = np.arange(count)
    unseen = held_out if len(held_out) >= FEWEST_UNSEEN else every
    alone = attempt(_response, uncorrected, lifts, detected.frames(_some(every, count, most)), None)
    lifts = lifts._replace(posterior=posterior._replace(corrections=np.stack((alone, alone))))
    hidden = attempt(
        _where_hidden, uncorrected[:2], lifts, detected.frames(_some(unseen, count, most))
    )
    in_time = alone
    if times is not None and prior.smooths:
        start = max(count - most, 0) // 2  # neighbours, to be smoothed
        middle = slice(start, start + most)
        in_time = attempt(_response, uncorrected, lifts, detected.frames(middle), times[middle])
    corrections = np.stack((alone, in_time))
    corrections[:, :2] = hidden
    posterior = posterior._replace(corrections=corrections)
    lifts = lifts._replace(posterior=posterior)
    usual = attempt(_usual, posterior.usual, lifts, detected.frames(_some(every, count, most)))
    return prior.with_posterior(posterior._replace(usual=usual))


def _some(frames: Int64, count: int, most: int) -> Bool:
    """Return which of `count` frames are a few of those given, `most` at most."""
    chosen = np.zeros(count, np.bool_)
    places = np.linspace(0, len(frames) - 1, min(most, len(frames)))
    chosen[frames[places.astype(np.int64)]] = True
    return chosen


class _Lifts(NamedTuple):
    """What lifts a finished prior with a posterior makes of keypoints."""

    prior: FittedPrior
    posterior: Posterior
    rig: Rig

    def lift(
        self, pixels: Float64, weights: Float32, times: Float64 | None
    ) -> tuple[LiftedFrames, ObservedFrames]:
        """Lift keypoints (N, K, P, 2) and confidences (N, K, P) of those that the prior knows."""
        known = self.prior.capture.known
        confidence = np.zeros((*weights.shape[:2], len(known)))
        keypoints = np.full((*confidence.shape, 2), np.nan)
        keypoints[:, :, known] = np.where((weights > 0)[..., None], pixels, np.nan)
        confidence[:, :, known] = weights
        observed = self.prior.observe(keypoints, confidence=confidence, times=times)
        lift = self.prior.lift_observed(observed, refine="full", uncertainty="off")
        return lift.of_keypoints(known), observed

    def frames(
        self, pixels: Float64, weights: Float32, times: Float64 | None
    ) -> tuple[Frames, Bool]:
        """Lift the same; return the frames, and which of them have a perspective camera.

        Others are any numbers.
        """
        lift, observed = self.lift(pixels, weights, times)
        there: Bool = np.all(np.isfinite(lift.points3d), axis=(1, 2))
        there &= np.any(lift.camera_models > 0, axis=1)
        lift = lift._replace(points3d=np.where(there[:, None, None], lift.points3d, 0))
        lifted = as_lifted(lift, self.posterior, self.rig, observed)
        return frames_as_detected(lifted, 0, len(there)), there


def _usual(lifts: _Lifts, detected: Observations) -> Float64:
    """Return the usual figures (3,) of the frames; 0 if none has a perspective camera."""
    lift, observed = lifts.lift(pixels_of(detected)[0], detected.weights, None)
    lifted = as_lifted(lift, lifts.posterior, lifts.rig, observed)
    found = lifts.posterior.deviations(lifted, observed.views, modes=False)
    known = found.figures[np.isfinite(found.figures).all(1)]
    return np.quantile(known, USUAL_SHARE, 0) if len(known) else lifts.posterior.usual


def _response(lifts: _Lifts, detected: Observations, times: Float64 | None) -> Float64:
    (pixels, _), noise = pixels_of(detected), lifts.posterior.noise
    frames, there = lifts.frames(pixels, detected.weights, times)
    steps = white_steps(frames.keypoints.shape, 0.0 if times is None else repetition(frames))
    moved = pixels + STEP * noise[:, :, None] * steps
    moved_frames, also = lifts.frames(moved, detected.weights, times)
    frames = _only(frames, there & also)
    removed = bool(lifts.posterior.left[0 if times is None else 1] < 1)
    shapes = lifts.posterior.shapes
    return response_of(frames, moved_frames, steps, shapes, noise, removed=removed)


def _where_hidden(lifts: _Lifts, detected: Observations) -> Float64:
    pixels, shown = pixels_of(detected)
    frames, there = lifts.frames(pixels, detected.weights, None)
    weights = np.where(hide_some(shown), 0, detected.weights).astype(np.float32)
    hidden, also = lifts.frames(pixels, weights, None)
    both = there & also
    return corrections_where_hidden(
        _only(frames, both), _only(hidden, both), lifts.posterior.shapes
    )


def _only(frames: Frames, chosen: Bool) -> Frames:
    """Return frames of which only some use their keypoints."""
    return frames._replace(weights=np.where(chosen[:, None, None], frames.weights, 0.0))
