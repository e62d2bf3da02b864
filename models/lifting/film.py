"""Films: frames with times, whose views are read in step and which are lifted part by part."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.clocks import frames_apart, in_step
from models.capture.motion import with_neighbours
from models.lifting.fitted_prior import FittedPrior
from models.lifting.lift import LiftedFrames
from models.lifting.observing import ObservedFrames
from models.settings.config import Refine
from models.settings.uncertainty import Uncertainty

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
# Keypoints (N, K, P, 2), confidence (N, K, P) and times (N,) or (N, K) in seconds.
Shown = tuple[Float32, Float32 | None, Float64 | None]
Read = Callable[[int, int], Shown]  # of the frames from the first number up to the second

AROUND = 3  # frames beside those that late views are read from, for interpolation
PART_FRAMES = 512


class Film(NamedTuple):
    """Frames of K views in step, and their neighbours in time, to be lifted by a prior."""

    prior: FittedPrior
    views: Sequence[int] | None  # of the fit, as for `FittedPrior.lift`
    keypoints: Float32  # (N, K, P, 2)
    confidence: Float32 | None  # (N, K, P)
    times: Float64 | None  # (N,) or (N, K) seconds; None: every frame is on its own
    own: slice  # the frames that are lifted; the others are there to be neighbours

    def observe(self) -> ObservedFrames:
        """Remove outliers and noise from all frames (`FittedPrior.observe`)."""
        return self.prior.observe(
            self.keypoints, confidence=self.confidence, views=self.views, times=self.times
        )

    @property
    def parts(self) -> Iterator[slice]:
        """The film's own frames in parts of `PART_FRAMES`, each for one call of `lift`."""
        for start in range(self.own.start, self.own.stop, PART_FRAMES):
            yield slice(start, min(start + PART_FRAMES, self.own.stop))

    def lift(
        self, part: slice, *, refine: Refine | None = None, uncertainty: Uncertainty = "sd"
    ) -> LiftedFrames:
        """Lift some frames, smoothed with their neighbours (`FittedPrior.lift`)."""
        smoothed = self.prior.smooths and self.times is not None
        around = with_neighbours(part) if smoothed else part
        return self.prior.lift(
            self.keypoints[around],
            confidence=None if self.confidence is None else self.confidence[around],
            refine=refine,
            views=self.views,
            times=None if self.times is None else self.times[around],
            only=slice(part.start - around.start, part.stop - around.start),
            uncertainty=uncertainty,
        )


def film_of(prior: FittedPrior, shown: Shown, views: Sequence[int] | None = None) -> Film:
    """Return a film of all frames that there are, as `read_film` does."""
    frames = len(shown[0])
    return read_film(prior, lambda _start, _stop: shown, slice(0, frames), frames, views)


def read_film(
    prior: FittedPrior,
    read: Read,
    own: slice,
    frames: int,
    views: Sequence[int] | None = None,
) -> Film:
    """Read some frames of a film, with those around them that smoothing and late views need.

    Parameters
    ----------
    own
        The frames to lift.
    frames
        How many the film has.
    views
        Which of the fit's views these are, as for `FittedPrior.lift`.
    """
    keypoints, confidence, times = read(own.start, own.stop)
    around = own
    if times is not None:
        clocks = prior.capture.clocks_of(views, keypoints.shape[1])
        around = with_neighbours(own) if prior.smooths else own
        if apart := frames_apart(times, clocks):
            around = slice(max(around.start - apart - AROUND, 0), around.stop + apart + AROUND)
        around = slice(around.start, min(around.stop, frames))
        if around != own:
            keypoints, confidence, times = read(around.start, around.stop)
        keypoints, confidence = in_step(keypoints, confidence, times, clocks)
    inside = slice(own.start - around.start, own.stop - around.start)
    return Film(prior, views, keypoints, confidence, times, inside)
