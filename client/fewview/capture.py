"""What the cameras saw: 2D keypoints of a few views, and what is known of them."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class CameraCalibration:
    """Cameras of a calibration that came with the keypoints, one for each view.

    Attributes
    ----------
    file
        Name of the file or the folder that they are from.
    names
        What it calls them, in the order of the views.
    cameras
        Each as an entry of ``calibration`` in the configuration of a fit.
    """

    file: str
    names: tuple[str, ...]
    cameras: tuple[dict[str, Any], ...]


@dataclass(frozen=True)
class SeenPerson:
    """Somebody whom one camera shows.

    Attributes
    ----------
    index
        The number that the option ``person`` has for them in this view.
    name
        That of their track; "" without.
    frames
        In how many frames they are seen.
    keypoints
        (P, 2) of one of these, in which they are seen as completely as in any; y goes down.
    picked
        Whether the capture has them, of this view.
    """

    index: int
    name: str
    frames: int
    keypoints: Float32
    picked: bool


@dataclass(frozen=True)
class ViewPeople:
    """Those whom one camera shows, who is seen most first, and the edges that join keypoints."""

    people: tuple[SeenPerson, ...]
    edges: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class Capture:
    """N frames of K views of P keypoints, as `POST /datasets` takes them.

    Attributes
    ----------
    keypoints
        (N, K, P, 2) pixels, x right, y down; NaN where not observed.
    confidence
        (N, K, P) in [0, 1]; 0 is not observed.
    points3d
        (N, P, 3): the truth, where there is one; it serves evaluation only.
    times
        (N,) or (N, K) seconds, rising.
    fps
        Frames per second, where frames follow each other at this rate.
    keypoint_names, edges
        The skeleton: P names, and (first, second) keypoints that are joined.
    view_names
        K names, such as those of files.
    image_sizes
        (width, height) in pixels of each view, None where unknown.
    numbers
        (N,) numbers of the frames in the files, where they do not simply count from 0.
    calibration
        The cameras of a calibration file that lies among the keypoints' files.
    people
        Whom each view shows, where a view shows several; if it was asked for.
    notes
        What a reader understood and changed, in sentences for people.
    """

    keypoints: Float32
    confidence: Float32 | None = None
    points3d: Float32 | None = None
    times: Float64 | None = None
    keypoint_names: tuple[str, ...] | None = None
    edges: tuple[tuple[int, int], ...] | None = None
    view_names: tuple[str, ...] | None = None
    image_sizes: tuple[tuple[int, int] | None, ...] | None = None
    fps: float | None = None
    notes: tuple[str, ...] = field(default=(), compare=False)
    numbers: NDArray[np.int64] | None = None
    calibration: CameraCalibration | None = field(default=None, compare=False)
    people: tuple[ViewPeople, ...] | None = field(default=None, compare=False)

    @property
    def frames(self) -> int:
        """Number of frames N."""
        return len(self.keypoints)

    @property
    def views(self) -> int:
        """Number of views K."""
        return int(self.keypoints.shape[1])

    def observed(self) -> NDArray[np.bool_]:
        """Return which keypoints (N, K, P) were observed."""
        return self.observed_in(slice(None))

    def observed_in(self, block: slice) -> NDArray[np.bool_]:
        """Return which keypoints (B, K, P) of a block of frames were observed."""
        seen = located(self.keypoints[block])
        return seen if self.confidence is None else seen & (self.confidence[block] > 0)

    def seconds(self) -> Float64 | None:
        """Return when frames were taken, (N,) or (N, K) in seconds, by times or rate; or None."""
        if self.times is None and self.fps is not None:
            return np.asarray(np.arange(self.frames) / self.fps)
        return self.times

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what `POST /datasets` takes as npz: arrays without pickled objects."""
        known: dict[str, Any] = {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "points3d": self.points3d,
            "times": self.times,
            "fps": self.fps,
            "keypoint_names": self.keypoint_names,
            "edges": self.edges,
            "view_names": self.view_names,
            "frame_numbers": self.numbers,
        }
        if self.image_sizes is not None and None not in self.image_sizes:
            known["image_sizes"] = self.image_sizes
        return {name: np.asarray(value) for name, value in known.items() if value is not None}


def located(points: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return which points (..., 2) have two finite coordinates.

    It is ten times as fast as a reduction over an axis of two.
    """
    return np.asarray(np.isfinite(points[..., 0]) & np.isfinite(points[..., 1]))
