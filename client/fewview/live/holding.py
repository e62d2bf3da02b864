"""Keypoints that are missing: held where they were, then faded, then gone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """The points of one moment.

    Attributes
    ----------
    sequence
        The number of the newest frame, as its sender wrote it.
    points
        (P, 3) where each point is, or was when it was last seen; NaN for those never seen.
    sds
        (P,) how far each may be off, in the unit of the points; NaN where it is not known.
    weights
        (P,) 1 for points that are there or held, falling to 0 while they fade.
    """

    sequence: int
    points: Float64
    sds: Float64
    weights: Float64


class Holder:
    """Remembers where P points were last seen, and when; all times are seconds of one clock."""

    def __init__(self, count: int, hold: float, fade: float) -> None:
        self._hold, self._fade = hold, fade
        self._points, self._sds = np.full((count, 3), np.nan), np.full(count, np.nan)
        self._seen = np.full(count, -np.inf)
        self._sequence = 0

    def take(self, sequence: int, points: Float64, sds: Float64 | None, now: float) -> Pose:
        """Take the points (P, 3) of a frame, NaN where missing, and return the pose."""
        there = np.isfinite(points).all(-1)
        self._points[there] = points[there]
        self._sds[there] = np.nan if sds is None else sds[there]
        self._seen[there] = now
        self._sequence = sequence
        return self.pose(now)

    def pose(self, now: float) -> Pose:
        """Return the pose at a time at which no frame came."""
        over = now - self._seen - self._hold
        falling = 1 - over / self._fade if self._fade else np.zeros_like(over)
        weights = np.where(over <= 0, 1.0, np.clip(falling, 0, 1))
        return Pose(self._sequence, self._points.copy(), self._sds.copy(), weights)
