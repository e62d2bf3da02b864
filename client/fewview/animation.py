"""What is written to files: points in time, with their names and what joins them."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fewview.calibration.camera import Camera

Float64 = NDArray[np.float64]

Unit = Literal["m", "mm"]
UNITS: tuple[Unit, ...] = ("m", "mm")
USUAL_RATE = 30.0  # frames per second if unknown, in formats that need a rate
UNEVEN = 0.5  # of a frame: as far as a time may be from the regular one next to it
WITHOUT_HOLE = 1.6  # median steps; rounded to milliseconds, 2.5 are 2 or 3


def rate_of(times: Float64) -> float | None:
    """Return the frames per second of times, None where they do not rise.

    Steps that are rounded, as to milliseconds, agree with it on average, and none by itself. So it
    is that of all frames between the first and the last, with those that are missing.
    """
    steps = np.diff(times)
    if len(steps) == 0 or not np.median(steps) > 0:
        return None
    steps = steps[steps > 0]
    step = steps[steps < WITHOUT_HOLE * np.median(steps)].mean()
    return float(np.rint(steps / step).sum() / steps.sum())


def _known_sds(given: Float64 | None, seen: NDArray[np.bool_]) -> Float64 | None:
    """Return the deviations of points that are seen (N, P), NaN elsewhere; None for none."""
    if given is None:
        return None
    sds = np.array(given, dtype=np.float64)
    if sds.shape != seen.shape or (sds < 0).any():
        raise ValueError(f"points_sd must be {seen.shape} distances, from 0")
    sds[~(seen & np.isfinite(sds))] = np.nan
    return None if np.isnan(sds).all() else sds


@dataclass(frozen=True)
class Animation:
    """N frames of P points in one frame of reference, right-handed.

    Tools for animation and biomechanics expect y up, as `fewview.room.to_room` returns it if up is
    known; writers do not rotate anything.

    Attributes
    ----------
    points
        (N, P, 3); a point with a coordinate that is not finite is missing, and NaN altogether.
    unit
        Of the points; None is unknown, as after a fit without a known length.
    fps
        Frames per second, where times are evenly spaced.
    times
        (N,) seconds, rising.
    keypoint_names
        P different names.
    edges
        (first, second) keypoints that are joined, counted from 0.
    numbers
        (N,) numbers of the frames, rising, if they do not simply count from 0.
    points_sd
        (N, P) how far points may be off, in their unit: `points3d_sd` of a lift. NaN where it is
        not known, and of missing points; None if it is known of none.
    cameras
        Those that saw the points, in their frame of reference; for formats that have a place for
        them.

    Raises
    ------
    ValueError
        If these do not fit together.
    """

    points: Float64
    unit: Unit | None = None
    fps: float | None = None
    times: Float64 | None = None
    keypoint_names: tuple[str, ...] | None = None
    edges: tuple[tuple[int, int], ...] = ()
    numbers: NDArray[np.int64] | None = None
    points_sd: Float64 | None = None
    cameras: tuple[Camera, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Take any sequences, and check them."""
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 3 or points.shape[2] != 3:
            raise ValueError(f"points must be (frames, keypoints, 3), they are {points.shape}")
        points[~np.isfinite(points).all(-1)] = np.nan
        frames, count = points.shape[:2]
        self._set("points", points)
        self._set("points_sd", _known_sds(self.points_sd, self.seen))
        if self.unit not in {None, *UNITS}:
            raise ValueError(f"unit must be 'm', 'mm' or None, not {self.unit!r}")
        if self.fps is not None and not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"fps must be above 0, not {self.fps!r}")
        if self.times is not None:
            times = np.array(self.times, dtype=np.float64)
            if times.shape != (frames,) or not np.isfinite(times).all():
                raise ValueError(f"times must be {frames} seconds, one a frame")
            if (np.diff(times) <= 0).any():
                raise ValueError("times must rise from frame to frame")
            self._set("times", times)
        if self.numbers is not None:
            numbers = np.array(self.numbers, dtype=np.int64)
            if numbers.shape != (frames,) or (np.diff(numbers) <= 0).any():
                raise ValueError(f"numbers must be {frames} that rise, one a frame")
            self._set("numbers", numbers)
        if self.keypoint_names is not None:
            names = tuple(str(name) for name in self.keypoint_names)
            if len(names) != count or len(set(names)) != count:
                raise ValueError(f"expected {count} keypoint names that all differ, got {names}")
            self._set("keypoint_names", names)
        edges = tuple((int(first), int(second)) for first, second in self.edges)
        for edge in edges:
            if not (min(edge) >= 0 and max(edge) < count and edge[0] != edge[1]):
                raise ValueError(f"edge {edge} does not join two of {count} keypoints")
        self._set("edges", edges)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def part(self, frames: slice) -> "Animation":
        """Return some of the frames, with all that is known of them."""
        of_frames = {name: getattr(self, name) for name in ("times", "numbers", "points_sd")}
        known = {name: each[frames] for name, each in of_frames.items() if each is not None}
        return replace(self, points=self.points[frames], **known)

    @property
    def names(self) -> tuple[str, ...]:
        """P names: those of the keypoints, or `point1`, `point2`, ..."""
        count = self.points.shape[1]
        return self.keypoint_names or tuple(f"point{place + 1}" for place in range(count))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which points (N, P) are there."""
        return np.isfinite(self.points[..., 0])

    @property
    def rate(self) -> float:
        """Frames per second: as given, by the times, or else 30."""
        if self.fps is not None:
            return float(self.fps)
        return USUAL_RATE if self.times is None else rate_of(self.times) or USUAL_RATE

    @property
    def frames(self) -> list[int]:
        """N numbers of the frames: those of the files, or from 0."""
        return list(range(len(self.points))) if self.numbers is None else self.numbers.tolist()

    @property
    def seconds(self) -> Float64:
        """The time (N,) of each frame, seconds: as given, or from 0 by `rate`."""
        if self.times is not None:
            return self.times
        frames = np.array(self.frames, np.float64)
        return np.asarray((frames - frames[:1]) / self.rate)

    @property
    def even(self) -> bool:
        """Whether times are those of a constant rate, to half a frame."""
        regular, times = np.arange(len(self.points)) / self.rate, self.seconds
        return bool(np.all(np.abs(times - times[:1] - regular) * self.rate <= UNEVEN))
