"""What a reader hands on: one camera's detections, of all people, as the file has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.calibration import Camera
from fewview.capture import Float32, Float64
from fewview.errors import FormatError
from fewview.readers.large_arrays import taken

Edges = tuple[tuple[int, int], ...]
Int64 = NDArray[np.int64]
MAX_NUMBERS = 2**29  # in one view's keypoints: 2 GiB
SEVERAL_SIZES = "images have several sizes, as of several cameras"
WIDEST = 2**20  # pixels of an image


@dataclass(frozen=True)
class View:
    """N frames of one camera, with M people or animals of P keypoints.

    Attributes
    ----------
    name
        Of the camera, from the file names.
    keypoints
        (N, M, P, 2) pixels, NaN where not detected.
    numbers
        (N,) number of each frame in its video.
    confidence
        (N, M, P), NaN where not known.
    people
        M names of people who keep their place in all frames; None if a frame lists its people in
        any order.
    keypoint_names, edges, image_size, times, fps, points3d
        As in `Capture`, of this view; `points3d` (N, P, 3).
    skeletons
        Names of skeletons of this format, which it identifies by their numbers of keypoints.
    pixels_from_zero
        Whether (0, 0) may be a detection; otherwise it means none.
    mirrored
        Whether the file shows that this is a mirror's image.
    camera
        That of a calibration in the same file.
    notes
        Sentences on how the file was read and what was left out.
    """

    name: str
    keypoints: Float32
    numbers: Int64
    confidence: Float32 | None = None
    people: tuple[str, ...] | None = None
    keypoint_names: tuple[str, ...] | None = None
    edges: Edges | None = None
    image_size: tuple[int, int] | None = None
    times: Float64 | None = None
    fps: float | None = None
    points3d: Float32 | None = None
    skeletons: tuple[str, ...] = ()
    pixels_from_zero: bool = False
    mirrored: bool = False
    camera: Camera | None = None
    notes: tuple[str, ...] = ()


Detections = Sequence[Sequence[Float32 | None]]


def packed(frames: Detections, what: str) -> tuple[Float32, Float32]:
    """Lay out lists of people, frame by frame, as arrays.

    Parameters
    ----------
    frames
        The people of each frame, each (P, 3) of x, y, confidence; None keeps a place free.
    what
        Names the file in errors.

    Returns
    -------
    tuple
        Keypoints (N, M, P, 2) and confidence (N, M, P), NaN where there is no person.

    Raises
    ------
    FormatError
        If there is no person at all, numbers of keypoints differ, or there is too much data.
    """
    counts = {len(person) for people in frames for person in people if person is not None}
    if not counts:
        raise FormatError(f"nobody was detected in any of its {len(frames)} frames", place=what)
    if len(counts) > 1:
        raise FormatError(
            f"people have {' or '.join(map(str, sorted(counts)))} keypoints; write one kind",
            place=what,
        )
    shape = (len(frames), max(len(people) for people in frames), counts.pop(), 3)
    bounded(shape, what)
    values = np.full(shape, np.nan, np.float32)
    for frame, people in enumerate(frames):
        for place, person in enumerate(people):
            if person is not None:
                values[frame, place] = person
    return values[..., :2], values[..., 2]


def bounded(shape: Sequence[int], what: str) -> None:
    """Refuse arrays that are too large to be keypoints."""
    size = int(np.prod(np.array(shape, float)))
    if size > MAX_NUMBERS:
        raise FormatError(
            f"{size:,} numbers {tuple(shape)} are too many; cut it in parts", place=what
        )


def size_in(record: Mapping[str, Any], width: str, height: str) -> tuple[int, int] | None:
    """Return the (width, height) that a record has under these names; None if it has none."""
    found = [record.get(width), record.get(height)]
    known = [int(each) for each in found if isinstance(each, int | float) and 0 < each < WIDEST]
    return (known[0], known[1]) if len(known) == 2 and min(known) > 0 else None


def with_keypoints(view: View, index: Sequence[int] | NDArray[np.intp]) -> View:
    """Return the view with the keypoints and confidences of these places among its P."""
    confidence = None if view.confidence is None else taken(view.confidence, index, axis=2)
    return replace(view, keypoints=taken(view.keypoints, index, axis=2), confidence=confidence)


def unseen(keypoints: Float32) -> NDArray[np.bool_]:
    """Return which keypoints (..., 2) are (0, 0) or (-1, -1), as detectors write unseen ones."""
    x, y = keypoints[..., 0], keypoints[..., 1]
    return np.asarray(((x == 0) | (x == -1)) & (x == y))
