"""FreeMoCap's 2D data, and plain arrays: .npy (views, frames, keypoints, 2), or of one view."""

from typing import Any

import numpy as np

from fewview.errors import FormatError
from fewview.readers.combining import SLIGHTLY_ABOVE
from fewview.readers.skeletons import SKELETONS
from fewview.readers.sources import NUMPY, Source
from fewview.readers.views import Edges, View, bounded

MOST_VIEWS = 32  # an array of more is taken for one whose frames come first
LOOKED_INTO = 1000  # frames
FACES = (468, 478)  # points of MediaPipe's face, after 33 of the body and 21 of each hand


def fits(source: Source) -> bool:
    """Whether this is an array of 2D keypoints; FreeMoCap has 3D in the names of 3D data."""
    if not source.begins(NUMPY) or "3d" in source.path.name.lower():
        return False
    try:
        array = np.load(source.path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return False
    if array.ndim == 3 and array.shape[-1] == 3 and array.dtype.kind in "fiu":
        third = array[:LOOKED_INTO, :, 2]
        return not np.any((third < 0) | (third > SLIGHTLY_ABOVE))
    return array.ndim in (3, 4) and array.shape[-1] in (2, 3)


def read(source: Source) -> list[View]:
    """Return the views of an array; a third number that is in [0, 1] is a confidence.

    Raises
    ------
    FormatError
        If it cannot be read, or holds 3D points.
    """
    try:
        values = np.load(source.path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"an .npy file that cannot be read ({error})", place=source) from error
    bounded(values.shape, str(source))
    if (
        values.dtype.kind not in "fiu"
        or values.ndim not in (3, 4)
        or values.shape[-1] not in (2, 3)
    ):
        raise FormatError(
            f"an array {values.shape} is not (views, frames, keypoints, 2)", place=source
        )
    array = np.array(values, np.float32)
    views = array if array.ndim == 4 else array[None]
    if len(views) > max(MOST_VIEWS, views.shape[1]):
        raise FormatError(
            f"an array {array.shape} would be of {len(views)} views of {views.shape[1]} "
            "frames; it has to be (views, frames, keypoints, 2): swap its first two axes",
            place=source,
        )
    third = views[..., 2] if views.shape[-1] == 3 else None
    notes: tuple[str, ...] = ()
    if third is not None and not (np.nanmin(third) >= 0 and np.nanmax(third) <= SLIGHTLY_ABOVE):
        if array.ndim == 3:
            raise FormatError(
                f"an array {array.shape} holds 3D points, not detections", place=source
            )
        third, notes = None, ("the third coordinate is no confidence and was left out",)
    names, edges = _holistic(views.shape[2])
    return [
        View(
            source.name if len(views) == 1 else f"view {v + 1}",
            view[:, None, :, :2],
            np.arange(len(view)),
            None if third is None else third[v][:, None],
            people=("",),
            keypoint_names=names,
            edges=edges,
            notes=notes,
        )
        for v, view in enumerate(views)
    ]


def _holistic(count: int) -> tuple[tuple[str, ...] | None, Edges | None]:
    """Return names and edges of MediaPipe's body, right hand, left hand and face."""
    body, hand = SKELETONS["mediapipe-33"], SKELETONS["hands-21"]
    start = len(body.names) + 2 * len(hand.names)
    if count - start not in FACES:
        return None, None
    names: list[Any] = list(body.names)
    edges = list(body.edges)
    for side in ("right", "left"):
        edges += [(a + len(names), b + len(names)) for a, b in hand.edges]
        names += [f"{side}_hand_{name}" for name in hand.names]
    names += [f"face_{index}" for index in range(count - start)]
    return tuple(names), tuple(edges)
