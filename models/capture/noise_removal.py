"""Removing noise from keypoints before anything else, in the way that suits their frames.

Frames with known times are smoothed with their neighbours. All others are denoised one by one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.capture.denoising import Denoiser, learn_denoiser
from models.capture.motion import MotionModel, learn_motion
from models.capture.observations import Observations, pixels_of
from models.settings.times import check_times

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


class NoiseRemoval(NamedTuple):
    """What a fit learnt about the noise of its keypoints; None where removing it would not help."""

    denoiser: Denoiser | None = None
    motion: MotionModel | None = None

    @property
    def views(self) -> int:
        """How many views the fit had; 0 if no noise is removed."""
        if self.denoiser is not None:
            return len(self.denoiser.mean)
        return 0 if self.motion is None else len(self.motion.noise)

    @property
    def noise(self) -> Float64 | None:
        """Noise (K, P) of the fit's own frames, standard deviations in pixels."""
        if self.motion is not None:
            return self.motion.noise
        return None if self.denoiser is None else self.denoiser.noise

    @property
    def removed(self) -> tuple[float, float] | None:
        """Overall noise before and after its removal, pixels; None if none was removed."""
        if self.motion is not None:
            return _root_mean_square(self.motion.noise), self.motion.left
        if self.denoiser is not None:
            return _root_mean_square(self.denoiser.noise), self.denoiser.remaining_noise
        return None

    @property
    def shares_left(self) -> tuple[float, float]:
        """Shares of the noise that are left: in frames one by one, and smoothed in time."""
        alone = 1.0
        if self.denoiser is not None:
            alone = self.denoiser.remaining_noise / _root_mean_square(self.denoiser.noise)
        if self.motion is None:
            return min(alone, 1.0), min(alone, 1.0)
        return min(alone, 1.0), min(self.motion.left / _root_mean_square(self.motion.noise), 1.0)

    def smooths(self, times: ArrayLike | None) -> bool:
        """Whether `remove` smooths frames with these times."""
        return times is not None and self.motion is not None

    def weighed(self, detected: Observations) -> Observations:
        """Weight the detected keypoints of the fit by the inverse variance of their noise.

        A keypoint of average noise keeps its weight.
        """
        if self.noise is None:
            return detected
        precisions = np.square(_root_mean_square(self.noise) / self.noise)
        return detected._replace(weights=detected.weights * precisions.astype(np.float32))

    def remove(
        self, observations: Observations, views: Sequence[int], times: ArrayLike | None
    ) -> Observations:
        """Replace the observed keypoints in `views` (of the fit) by their expectation.

        `times` (N,) or (N, K) are in seconds, rising; those of the first view are used. None if
        they are not known. Raises ValueError if they are malformed (see `check_times`).
        """
        if times is None:
            return self._one_by_one(observations, views)
        frames, count = observations.usable.shape
        seconds = check_times(times, frames=frames, views=count).reshape(frames, -1)[:, 0]
        if self.motion is None:
            return self._one_by_one(observations, views)
        smoothed, together = self.motion.smooth(observations, seconds, views)
        if together.all():
            return smoothed
        alone, shape = self._one_by_one(observations, views), (-1, 1, 1, 1)
        return Observations(
            np.where(together.reshape(shape), smoothed.keypoints, alone.keypoints),
            np.where(together.reshape(shape[:3]), smoothed.weights, alone.weights),
            np.where(together.reshape(shape[:3]), smoothed.centres, alone.centres),
            np.where(together.reshape(shape[:2]), smoothed.sizes, alone.sizes),
            np.where(together.reshape(shape[:2]), smoothed.usable, alone.usable),
        )

    def detected(
        self, observations: Observations, views: Sequence[int], times: ArrayLike | None
    ) -> Float32:
        """Return the keypoints as they were before `remove`, to compare with later.

        (N, K, P, 3): pixels, and the inverse variance of their noise, 0 where not observed.
        (0, K, P, 3) if `remove` does not treat these frames one by one.
        """
        if self.denoiser is None or self.smooths(times):
            return np.zeros((0, *observations.weights.shape[1:], 3), np.float32)
        pixels, _ = pixels_of(observations)
        precisions = observations.weights / np.square(self.denoiser.noise[list(views)])
        return np.concatenate((pixels, precisions[..., None]), axis=-1, dtype=np.float32)

    def _one_by_one(self, observations: Observations, views: Sequence[int]) -> Observations:
        return observations if self.denoiser is None else self.denoiser.denoise(observations, views)


def _root_mean_square(values: Float64) -> float:
    return float(np.sqrt(np.square(values).mean()))


def learn_noise_removal(observations: Observations, times: Float64 | None) -> NoiseRemoval:
    """Learn from a capture; `times` (N,) are those of its frames in seconds, None if unknown."""
    motion = None if times is None else learn_motion(observations, times)
    return NoiseRemoval(learn_denoiser(observations), motion)
