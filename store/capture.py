"""A capture's arrays, checked, and the bytes they are stored as."""

import hashlib
import io
import json
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.settings.keypoints import check_confidence, check_keypoints
from models.settings.times import check_times
from store.array_files import PIECE_BYTES, safetensors_arrays, safetensors_header
from store.errors import CaptureError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Array = TypeVar("Array", bound=NDArray[Any])

ARRAYS = ("keypoints", "confidence", "points3d", "times")  # of a capture, in this order
STORED = sorted(ARRAYS, key="times".__ne__)  # in a file the numbers of eight bytes come first


@dataclass(frozen=True)
class Capture:
    """What the cameras saw, and for evaluation only what was really there.

    Attributes
    ----------
    keypoints
        (N frames, K views, P keypoints, 2) pixels; x right, y down; NaN where not observed.
    confidence
        (N, K, P) in [0, 1], or None.
    points3d
        (N, P, 3) ground truth in the unit the user chose, NaN where unknown, or None.
    times
        (N,) or (N, K) seconds, rising: when each frame was taken, or each of its views; or None.
    """

    keypoints: Float32
    confidence: Float32 | None = None
    points3d: Float32 | None = None
    times: Float64 | None = None

    @classmethod
    def checked(
        cls,
        keypoints: ArrayLike,
        confidence: ArrayLike | None = None,
        points3d: ArrayLike | None = None,
        times: ArrayLike | None = None,
    ) -> "Capture":
        """Return the capture these arrays make, which are changed where that spares a copy.

        Raises
        ------
        CaptureError
            Naming the array, what was expected of it, what came and how to mend it.
        """
        pixels = _checked("keypoints", lambda: check_keypoints(keypoints))
        n, k, p, _ = pixels.shape
        if n == 0:
            raise CaptureError("keypoints", "expected at least one frame, got none")
        pixels = _whole_points(pixels)
        weights = None
        if confidence is not None:
            weights = _checked(
                "confidence", lambda: check_confidence(confidence, expected=pixels.shape[:3])
            )
        truth = None
        if points3d is not None:
            truth = _checked("points3d", lambda: np.asarray(points3d, dtype=np.float32))
            if truth.shape != (n, p, 3):
                raise CaptureError(
                    "points3d",
                    f"expected shape (frames, keypoints, 3) = {(n, p, 3)}, got {truth.shape}",
                )
            if np.isinf(truth).any():
                raise CaptureError(
                    "points3d", "expected finite coordinates, got infinity; write NaN for unknown"
                )
            truth = _whole_points(truth)
        seconds = None
        if times is not None:
            seconds = _checked("times", lambda: check_times(times, frames=n, views=k))
        return cls(pixels, weights, truth, seconds)

    @property
    def frames(self) -> int:
        """N, the number of frames."""
        return len(self.keypoints)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which keypoints (N, K, P) were observed: they have coordinates and some confidence."""
        there = ~np.isnan(self.keypoints[..., 0])
        return there if self.confidence is None else there & (self.confidence > 0)

    def observed(self) -> list[int]:
        """Return how many keypoints each view saw, over all frames."""
        return [int(count) for count in self.seen.sum((0, 2))]

    def to_bytes(self) -> bytes:
        """Return the arrays as safetensors, with the CRC-32 of each in the header."""
        every = {name: getattr(self, name) for name in STORED}
        arrays = {n: np.ascontiguousarray(a) for n, a in every.items() if a is not None}
        header = safetensors_header(
            [(n, f"F{8 * a.itemsize}", a.shape, a.itemsize) for n, a in arrays.items()],
            {n: str(zlib.crc32(a.data)) for n, a in arrays.items()},
        )
        whole = io.BytesIO(header)
        whole.seek(0, io.SEEK_END)
        for array in arrays.values():
            rows = array.reshape(-1).view(np.uint8).data
            for start in range(0, len(rows), PIECE_BYTES):  # other threads have turns between
                whole.write(rows[start : start + PIECE_BYTES])
        return whole.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> "Capture":
        """Read back what :meth:`to_bytes` wrote."""
        arrays = safetensors_arrays(data)
        return cls(**{name: arrays[name] for name in ARRAYS if name in arrays})

    @classmethod
    def frames_from(cls, read: Callable[[int, int], bytes], frames: slice) -> "Capture":
        """Read some frames of what :meth:`to_bytes` wrote, without the ground truth.

        Parameters
        ----------
        read
            Gives the bytes from a start up to an end.
        frames
            Which frames, from a start up to a stop that is not beyond the last.
        """
        size = int.from_bytes(read(0, 8), "little")
        header = json.loads(read(8, 8 + size))

        def rows(name: str, dtype: str = "<f4") -> NDArray[Any] | None:
            if name not in header:
                return None
            shape = header[name]["shape"][1:]
            first = 8 + size + header[name]["data_offsets"][0]
            each = np.dtype(dtype).itemsize * math.prod(shape)
            data = read(first + each * frames.start, first + each * frames.stop)
            return np.frombuffer(data, dtype).reshape(-1, *shape)

        keypoints = rows("keypoints")
        assert keypoints is not None  # noqa: S101 (every capture has them)
        return cls(keypoints, rows("confidence"), times=rows("times", "<f8"))


def checksums_in(header: dict[str, Any]) -> dict[str, int]:
    """Return the CRC-32s of arrays, by name, from the header of a stored capture.

    Captures that older versions stored have none.
    """
    return {name: int(text) for name, text in header.get("__metadata__", {}).items()}


def concatenate(captures: list[Capture]) -> Capture:
    """Join captures of the same views and keypoints, frame after frame.

    Where only some have confidence, the others' keypoints count fully; where only some have a
    ground truth, the others' is unknown (NaN). Either all have times or none.
    """
    confidence = points3d = times = None
    if any(capture.confidence is not None for capture in captures):
        confidence = np.concatenate(
            [
                np.ones(c.keypoints.shape[:3], np.float32) if c.confidence is None else c.confidence
                for c in captures
            ]
        )
    if any(capture.points3d is not None for capture in captures):
        points3d = np.concatenate(
            [
                np.full((c.frames, c.keypoints.shape[2], 3), np.nan, np.float32)
                if c.points3d is None
                else c.points3d
                for c in captures
            ]
        )
    if all(capture.times is not None for capture in captures):
        times = np.concatenate([c.times for c in captures if c.times is not None])
    return Capture(np.concatenate([c.keypoints for c in captures]), confidence, points3d, times)


def extend_checksum(checksum: str, capture: Capture) -> str:
    """Return the SHA-256 chain over all frames so far, extended by those of ``capture``.

    Each link hashes the one before it and one frame's little-endian arrays, so a capture has the
    same checksum however it was cut into uploads. The chain of no frames is the empty string.
    """
    arrays = {name: getattr(capture, name) for name in ARRAYS}
    frames = [
        array.astype("<f8" if name == "times" else "<f4", copy=False).reshape(capture.frames, -1)
        for name, array in arrays.items()
        if array is not None
    ]
    link = bytes.fromhex(checksum)
    for rows in zip(*frames, strict=True):
        link = hashlib.sha256(link + b"".join(row.tobytes() for row in rows)).digest()
    return link.hex()


def _whole_points(points: Float32) -> Float32:
    """Return points with NaN in all coordinates where one has it; in place where that can be."""
    missing = np.isnan(points).any(-1)
    if missing.any():
        points = np.require(points, requirements="W")
        points[missing] = np.nan
    return points


def _checked(field: str, check: Callable[[], Array]) -> Array:
    try:
        return check()
    except (TypeError, ValueError) as error:
        raise CaptureError(field, str(error)) from error
