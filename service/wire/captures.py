"""Captures in requests: nested lists or arrays in, a checked capture out."""

import numpy as np
from fewview.readers.combining import SLIGHTLY_ABOVE
from numpy.typing import NDArray

from models.settings.keypoints import MIN_KEYPOINTS
from service.http.errors import invalid
from service.http.uploads import Upload
from service.settings import Settings
from service.wire import arrays
from service.wire.arrays import Arrays
from store.capture import Capture
from store.errors import CaptureError

POINT_AXES = ("frames", "views", "keypoints", "x y")
TRUTH_AXES = ("frames", "keypoints", "x y z")


def to_capture(
    keypoints: object,
    confidence: object = None,
    points3d: object = None,
    times: object = None,
    *,
    settings: Settings,
    keypoints_field: str = "keypoints",
    expected_keypoints: int | None = None,
    notes: list[str] | None = None,
) -> Capture:
    """Check nested lists or arrays against the limits and return the capture they make.

    Confidences a little above 1, such as peaks between the pixels of a heatmap, are clipped;
    `notes` get a sentence on that.
    """
    sizes = (None, None, expected_keypoints, 2)
    limit = settings.max_body_bytes
    try:
        pixels = _array(keypoints, keypoints_field, POINT_AXES, sizes, limit)
        shape = pixels.shape
        most = (settings.max_frames, settings.max_views, settings.max_keypoints)
        for axis, count, allowed in zip(POINT_AXES, shape, most, strict=False):
            if count > allowed:
                raise CaptureError("keypoints", f"expected at most {allowed} {axis}, got {count}")
        if shape[2] < MIN_KEYPOINTS:
            raise CaptureError(
                "keypoints",
                f"expected {MIN_KEYPOINTS} to {settings.max_keypoints} keypoints, got {shape[2]}",
            )
        if shape[3] == 3:
            raise CaptureError(
                "keypoints",
                "expected x and y of each keypoint, got three numbers; if the third is its "
                f"confidence, send {keypoints_field}[..., :2] as `{keypoints_field}` and "
                f"{keypoints_field}[..., 2] as `confidence`",
            )
        return Capture.checked(
            pixels,
            None
            if confidence is None
            else _clipped(
                _array(confidence, "confidence", POINT_AXES[:3], shape[:3], limit), notes
            ),
            None
            if points3d is None
            else _array(points3d, "points3d", TRUTH_AXES, (shape[0], shape[2], 3), limit),
            None if times is None else _times(times, shape),
        )
    except CaptureError as error:
        name = keypoints_field if error.field == "keypoints" else error.field
        raise invalid(f"/{name}", str(error)) from error


def _clipped(confidence: NDArray[np.float32], notes: list[str] | None) -> NDArray[np.float32]:
    highest = float(np.fmax.reduce(confidence, axis=None, initial=0.0))
    if not 1 < highest <= SLIGHTLY_ABOVE:
        return confidence
    if notes is not None:
        notes.append(f"confidences up to {highest:.3f} were clipped to 1")
    return np.minimum(confidence, np.float32(1))


def read_arrays(upload: Upload, settings: Settings, known: frozenset[str]) -> Arrays:
    """Read the arrays of an upload's file that an operation knows; captures come with others."""
    found = arrays.from_bytes(upload.data, max_bytes=settings.max_body_bytes)
    return {name: array for name, array in found.items() if name in known}


def _times(value: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return seconds as float64: float32 would round the times of a clock to minutes."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "iuf":
            raise invalid("/times", f"expected an array of numbers, got {value.dtype}")
        return value.astype(np.float64)
    rows = value if isinstance(value, list) and value else [None]
    by_view = isinstance(rows[0], list)
    for place, row in enumerate(rows):
        numbers = row if by_view else [row]
        regular = isinstance(numbers, list) and len(numbers) == (shape[1] if by_view else 1)
        if not regular or not all(type(number) in (int, float) for number in numbers):
            raise invalid(
                f"/times/{place}",
                "expected seconds: a number a frame, or a list of a number a view in all frames",
            )
    return np.array(rows, np.float64)


def _array(
    value: object,
    name: str,
    axes: tuple[str, ...],
    sizes: tuple[int | None, ...],
    max_bytes: int,
) -> NDArray[np.float32]:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "iuf":
            raise invalid(f"/{name}", f"expected an array of numbers, got {value.dtype}")
        if value.ndim != len(axes):
            raise invalid(f"/{name}", f"expected axes ({', '.join(axes)}), got shape {value.shape}")
        with np.errstate(over="ignore"):  # what becomes infinite is refused with the infinite
            return value.astype(np.float32)
    return arrays.from_nested(value, f"/{name}", axes=axes, sizes=sizes, max_bytes=max_bytes)
