"""Views whose frames show other moments than those of the first view: reading them in step.

A view is read between its frames by cubic interpolation (Lagrange's, through four frames), or a
linear one next to gaps. What was not observed stays so, and nothing is read across a cut or a
pause. The common times are those of the first view.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capture.tracks import number_clips

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

PAUSE = 2.5  # times the usual time between frames: nothing is read within a longer one
EVEN = 1.2  # between the longest and the shortest time of frames that a cubic goes through
WHOLE = 1e-4  # of a frame: what is nearer to a frame than this is that frame


class Clocks(NamedTuple):
    """By how many seconds each of K views is late, at M times; in between it is interpolated.

    Before the first and after the last of these times, a view is as late as there.
    """

    times: Float64  # (M,) seconds, rising
    offsets: Float64  # (M, K) seconds; 0 for a view that is in step

    def at(self, times: Float64) -> Float64:
        """Return by how many seconds the views are late (T, K) at `times` (T,)."""
        late = [np.interp(times, self.times, offsets) for offsets in self.offsets.T]
        return np.stack(late, axis=1)

    def suit(self, views: int) -> bool:
        """Whether these can be the clocks of so many views."""
        shape = (len(self.times), views)
        return (
            self.times.ndim == 1
            and len(self.times) > 0
            and self.offsets.shape == shape
            and bool(np.isfinite(self.times).all() and np.isfinite(self.offsets).all())
            and bool((np.diff(self.times) > 0).all())
        )

    def of_views(self, views: Sequence[int]) -> "Clocks":
        """Return the clocks of some of the views, in the order given."""
        return Clocks(self.times, self.offsets[:, list(views)])


def in_step(
    keypoints: Float32,
    confidence: Float32 | None,
    times: Float64 | None,
    clocks: Clocks | None = None,
) -> tuple[Float32, Float32 | None]:
    """Read all views at the times of the first: keypoints (N, K, P, 2), confidence (N, K, P).

    Without times (N,) or (N, K) in seconds, nothing is known of when, and all stays as it is.
    """
    if times is None:
        return keypoints, confidence
    times = times_of_views(times, keypoints.shape[1])
    return read_at(keypoints, confidence, positions_in_step(times, clocks), _even(times))


def frames_apart(times: Float64, clocks: Clocks | None = None) -> int:
    """Return by how many frames views are read before or after their own, at most.

    `times` (N,) or (N, K) are in seconds; 0 where nothing is to be read at another time.
    """
    if len(times) < 2:
        return 0
    by_view = times.reshape(len(times), -1)
    first = by_view[:, 0]
    late = np.abs(by_view - first[:, None]).max()
    if clocks is not None:
        late += np.abs(clocks.offsets).max()
    return int(np.ceil(late / np.median(np.diff(first)))) if late else 0


def times_of_views(times: Float64, views: int) -> Float64:
    """Return times (N, K) from those of frames (N,), or of the views of each frame (N, K)."""
    return np.broadcast_to(times.reshape(len(times), -1), (len(times), views))


def positions_in_step(times: Float64, clocks: Clocks | None = None) -> Float64:
    """Return which frames (N, K), in fractions, of each view show what the first view's show.

    `times` (N, K) are those of the views' own frames, in seconds. NaN where a view has no frames
    around the moment.
    """
    count, views = times.shape
    late = np.zeros(times.shape) if clocks is None else clocks.at(times[:, 0])
    frames = np.arange(count, dtype=np.float64)
    positions = np.full(times.shape, np.nan)
    for view in range(views):
        own, wanted = times[:, view], times[:, 0] + late[:, view]
        if count < 2 or (not late[:, view].any() and np.array_equal(own, times[:, 0])):
            positions[:, view] = np.where(wanted == own, frames, np.nan)
            continue
        found = np.interp(wanted, own, frames, left=np.nan, right=np.nan)
        # A little before the first frame or after the last one is that frame.
        step = float(np.median(np.diff(own)))
        found = np.where(np.abs(wanted - own[0]) < WHOLE * step, 0.0, found)
        found = np.where(np.abs(wanted - own[-1]) < WHOLE * step, count - 1.0, found)
        nearest = np.round(found)
        whole = np.abs(found - nearest) < WHOLE
        before = np.clip(np.nan_to_num(found), 0, count - 2).astype(np.int64)
        pauses = (np.diff(own) > PAUSE * step)[before]
        positions[:, view] = np.where(whole, nearest, np.where(pauses, np.nan, found))
    return positions


def _even(times: Float64) -> Bool:
    """Whether frame n and the next one (N, K) lie as far apart as the two around them."""
    steps = np.diff(times, axis=0)
    before, after = (
        np.concatenate(both) for both in ((steps[:1], steps[:-1]), (steps[1:], steps[-1:]))
    )
    three = np.stack((before, steps, after))
    even = three.max(0) < EVEN * three.min(0)
    return np.concatenate((even, even[-1:] if len(even) else np.ones_like(times, np.bool_)))


def read_at(
    keypoints: Float32, confidence: Float32 | None, positions: Float64, even: Bool
) -> tuple[Float32, Float32 | None]:
    """Read keypoints (N, K, P, 2) and confidence (N, K, P) at `positions` (N, K), in frames.

    A view that is read at its own frames stays as it is, bit for bit. Where frames around a
    position are not `even` (N, K) in time, interpolation is linear.
    """
    frames = np.arange(len(keypoints))
    pixels = keypoints.copy()
    weights = None if confidence is None else confidence.copy()
    for view in np.flatnonzero((positions != frames[:, None]).any(0)):
        own = None if confidence is None else confidence[:, view]
        pixels[:, view], read = _read_view(
            keypoints[:, view], own, positions[:, view], even[:, view]
        )
        if weights is not None and read is not None:
            weights[:, view] = read
    return pixels, weights


def _read_view(
    pixels: Float32, confidence: Float32 | None, positions: Float64, even: Bool
) -> tuple[Float32, Float32 | None]:
    """Read one view's keypoints (N, P, 2) and confidence (N, P) at positions (T,)."""
    there = np.asarray(np.isfinite(pixels).all(-1))
    if confidence is not None:
        there = there & (confidence > 0)
    clips = number_clips(np.nan_to_num(pixels).astype(np.float64), there.astype(np.float64))
    known = np.isfinite(positions)
    low = np.where(known, np.floor(positions), 0).astype(np.int64)
    share = np.where(known, positions - low, 0.0)[:, None, None]  # (T, 1, 1)
    high = low + (share[:, 0, 0] > 0)
    values = np.nan_to_num(pixels).astype(np.float64)
    seen = there[low] & there[high] & (known & (clips[low] == clips[high]))[:, None]  # (T, P)
    linear = values[low] + share * (values[high] - values[low])
    earlier, later = np.maximum(low - 1, 0), np.minimum(high + 1, len(pixels) - 1)
    around = even[low] & (earlier < low) & (later > high) & (clips[earlier] == clips[later])
    smooth = seen & there[earlier] & there[later] & around[:, None]
    # Lagrange's cubic, in second differences: what does not move stays at the very same pixel.
    bend = (2 - share) * (values[earlier] - 2 * values[low] + values[high])
    bend += (1 + share) * (values[low] - 2 * values[high] + values[later])
    cubic = linear - share * (1 - share) / 6 * bend
    read = np.where(smooth[..., None] & (share > 0), cubic, linear)
    if confidence is None:
        return np.where(seen[..., None], read, np.nan).astype(np.float32), None
    trust = (1 - share[..., 0]) * confidence[low] + share[..., 0] * confidence[high]
    return (
        np.where(seen[..., None], read, np.nan).astype(np.float32),
        np.where(seen, trust, 0).astype(np.float32),
    )
