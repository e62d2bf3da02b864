"""Captures in requests: nested lists or arrays in, a checked capture out."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from fewview.readers.combining import SLIGHTLY_ABOVE
from numpy.typing import NDArray

from models.settings.keypoints import MIN_KEYPOINTS
from service.http.errors import ApiError, invalid
from service.http.uploads import Upload
from service.settings import Settings
from service.wire import arrays
from service.wire.arrays import Arrays, Unlisted
from store.capture import Capture
from store.errors import CaptureError

POINT_AXES = ("frames", "views", "keypoints", "x y")
TRUTH_AXES = ("frames", "keypoints", "x y z")
POINTS = ("keypoints", "frames")  # what fields of these are called

Shape = tuple[int | None, ...]  # (frames, views, keypoints, 2), None where it is not known
Converted = dict[str, NDArray[Any] | Unlisted | ApiError]


def to_capture(
    keypoints: object,
    confidence: object = None,
    points3d: object = None,
    times: object = None,
    *,
    settings: Settings,
    max_bytes: int | None = None,
    keypoints_field: str = "keypoints",
    expected_keypoints: int | None = None,
    notes: list[str] | None = None,
) -> Capture:
    """Check nested lists or arrays against the limits and return the capture they make.

    No array takes more than ``max_bytes``, without it as many as the largest body has. Confidences
    a little above 1, such as peaks between the pixels of a heatmap, are clipped; `notes` get a
    sentence on that.
    """
    limit = settings.max_body_bytes if max_bytes is None else max_bytes
    expected = (None, None, expected_keypoints, 2)
    try:
        pixels = to_array(keypoints, keypoints_field, expected, limit)
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
            else _clipped(to_array(confidence, "confidence", shape, limit), notes),
            None if points3d is None else to_array(points3d, "points3d", shape, limit),
            None if times is None else to_array(times, "times", shape, limit),
        )
    except CaptureError as error:
        name = keypoints_field if error.field == "keypoints" else error.field
        raise invalid(f"/{name}", str(error)) from error


def to_array(value: object, name: str, shape: Shape, max_bytes: int) -> NDArray[Any]:
    """Return the array that a field of a body makes.

    Parameters
    ----------
    value
        Nested lists, or what `convert` made of them.
    name
        The field's, by which its axes are known.
    shape
        Of the keypoints that it is beside.

    Raises
    ------
    ApiError
        As `arrays.from_nested`.
    """
    if isinstance(value, ApiError):
        raise value
    if name == "times":
        return _times(value, shape)
    sizes: Shape = (None, None, 3)  # of structures
    if name in POINTS:
        sizes = (None, shape[1], shape[2], 2)
    elif name == "confidence":
        sizes = shape[:3]
    elif name == "points3d":
        sizes = (shape[0], shape[2], 3)
    axes = POINT_AXES[: len(sizes)] if name in (*POINTS, "confidence") else TRUTH_AXES
    return _array(value, name, axes, sizes, max_bytes)


def convert(fields: Mapping[str, object], max_bytes: int) -> Converted:
    """Return the arrays in the fields of a body, or the error of a field that is no array.

    If there are no keypoints, fields that need them are left out. Lists of nulls alone stay open,
    because a model may give the number of their keypoints.
    """
    found: Converted = {}
    shape: Shape = (None, None, None, 2)
    for name in sorted(fields, key=lambda name: name not in POINTS):
        value = fields[name]
        try:
            array = to_array(value, name, shape, max_bytes)
        except ApiError as error:
            nulls = _unlisted(value, name, max_bytes) if shape[2] is None else None
            found[name] = nulls or error
            if name in POINTS:
                if nulls is None:
                    break
                shape = (*nulls, None, 2)
        else:
            found[name] = array
            shape = array.shape if name in POINTS else shape
    return found


def _unlisted(value: object, name: str, max_bytes: int) -> Unlisted | None:
    """Return the sizes of a list of frames if they hold nothing but nulls, or views of nulls."""
    if isinstance(value, list) and set(map(type, value)) == {type(None)}:
        return Unlisted(len(value), None)
    for views in (None, 1):
        try:
            array = to_array(value, name, (None, views, 1, 2), max_bytes)
        except ApiError:
            continue
        return Unlisted(len(array), array.shape[1] if views is None else None)
    return None


def _clipped(confidence: NDArray[np.float32], notes: list[str] | None) -> NDArray[np.float32]:
    highest = float(np.fmax.reduce(confidence, axis=None, initial=0.0))
    if not 1 < highest <= SLIGHTLY_ABOVE:
        return confidence
    if notes is not None:
        notes.append(f"confidences up to {highest:.3f} were clipped to 1")
    return np.minimum(confidence, np.float32(1))


def read_arrays(upload: Upload, known: frozenset[str]) -> Arrays:
    """Read the arrays of an upload's file that an operation knows; captures come with others."""
    found = arrays.from_bytes(upload.data, max_bytes=upload.max_array_bytes)
    return {name: array for name, array in found.items() if name in known}


def _times(value: object, shape: Shape) -> NDArray[np.float64]:
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
    sizes: Shape,
    max_bytes: int,
) -> NDArray[np.float32]:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "iuf":
            raise invalid(f"/{name}", f"expected an array of numbers, got {value.dtype}")
        if value.ndim != len(axes):
            raise invalid(f"/{name}", f"expected axes ({', '.join(axes)}), got shape {value.shape}")
        with np.errstate(over="ignore"):  # what becomes infinite is refused with the infinite
            return value.astype(np.float32, copy=not value.flags.writeable)
    return arrays.from_nested(value, f"/{name}", axes=axes, sizes=sizes, max_bytes=max_bytes)
