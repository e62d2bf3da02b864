"""Tables with a column for each x, y and confidence, as views: of text and of HDF5 by pandas."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fewview.capture import Float32, Float64, located
from fewview.errors import FormatError
from fewview.readers.file_names import frame_number, natural
from fewview.readers.headers import Label, plain
from fewview.readers.large_arrays import blocks, built, taken
from fewview.readers.skeletons import SKELETONS
from fewview.readers.views import Int64, View, bounded

_WHOLE = re.compile(r"\d{1,18}(\.0*)?")
COORDINATES = {"x": 0, "y": 1, "confidence": 2, "visibility": 2}
MAX_COLUMNS = 2**16  # of a table: 21,845 keypoints with their confidence
HANDS = {"wrist", "thumbcmc", "thumbmcp", "thumbip", "thumbtip"} | {
    f"{finger}finger{joint}"
    for finger in ("index", "middle", "ring", "pinky")
    for joint in ("mcp", "pip", "dip", "tip")
}
OF_MEDIAPIPE = HANDS.union(map(plain, SKELETONS["mediapipe-33"].names))
MANY_OF_MEDIAPIPE = (21, 33, 468, 478)  # landmarks of a hand, a body, a face
INSIDE = 0.8  # of all landmarks lie in the image, where they are shares of it
OF_3D = (
    "has columns of x, y and z, so it holds 3D points; Fewview makes 3D from the 2D keypoints of "
    "each camera: give those"
)


def views_of_columns(
    name: str, labels: Sequence[Label], values: Float32 | Float64, numbers: Int64, what: str
) -> list[View]:
    """Return the views of a table, one for each camera that its labels name.

    Parameters
    ----------
    labels
        Of C columns. Keypoints without an x or a y are left out.
    values
        (N, C).
    numbers
        (N,) number of each frame.
    what
        Names the file in errors.

    Raises
    ------
    FormatError
        If there are no columns of x and y, or there is a depth that makes the points 3D.
    """
    bounded_columns(len(labels), what)
    cameras = sorted({label.camera for label in labels}, key=natural)
    views = []
    for camera in cameras:
        mine = [place for place, label in enumerate(labels) if label.camera == camera]
        part = values if len(cameras) == 1 else taken(values, mine, axis=1)
        views.append(view_of_labels(camera or name, [labels[i] for i in mine], part, numbers, what))
    return views


def view_of_labels(
    name: str, labels: Sequence[Label], values: Float32 | Float64, numbers: Int64, what: str
) -> View:
    """Return the view of one camera's columns, as `views_of_columns` does of all."""
    people = tuple(dict.fromkeys(label.person for label in labels))
    with_x, with_y = ({each.keypoint for each in labels if each.axis == axis} for axis in "xy")
    whole = with_x & with_y
    points = list(dict.fromkeys(each.keypoint for each in labels if each.keypoint in whole))
    if not points:
        raise FormatError("has no columns of x and y", place=what)
    numbered = all(point.isdecimal() for point in points)
    if numbered:
        points.sort(key=natural)
    shape = (len(values), len(people), len(points), 3)
    bounded(shape, what)
    place = {person: i for i, person in enumerate(people)}
    point = {keypoint: i for i, keypoint in enumerate(points)}
    columns = [
        (column, place[label.person], point[label.keypoint], COORDINATES[label.axis])
        for column, label in enumerate(labels)
        if label.axis in COORDINATES and label.keypoint in point
    ]
    measured = any(axis == 2 for *_, axis in columns)
    out = _laid_out(values, columns, shape)
    view = View(
        name,
        out[..., :2],
        numbers,
        out[..., 2] if measured else None,
        people=people,
        keypoint_names=None if numbered else tuple(points),
    )
    depths = [column for column, label in enumerate(labels) if label.axis == "z"]
    if not depths:
        return view
    axes = {label.axis for label in labels}
    return without_depth(view, taken(values, depths, axis=1), what, visible="visibility" in axes)


def _laid_out(
    values: Float32 | Float64, columns: Sequence[tuple[int, ...]], shape: tuple[int, ...]
) -> Float32:
    """Return an array (N, M, P, 3) with these columns (N, C) at their places, NaN elsewhere.

    Parameters
    ----------
    columns
        A column and its person, keypoint and coordinate, each.
    """
    index = np.array([column for column, *_ in columns])
    places = np.ravel_multi_index(tuple(np.array([where for _, *where in columns]).T), shape[1:])
    whole = np.arange(int(np.prod(shape[1:])))
    if (
        values.dtype == np.float32
        and values.shape[1] == len(whole)
        and np.array_equal(index, whole)
        and np.array_equal(places, whole)
    ):
        return values.astype(np.float32, copy=False).reshape(shape)  # as they are

    def part(block: slice) -> Float32:
        rows = np.full((block.stop - block.start, len(whole)), np.nan, np.float32)
        rows[:, places] = values[block][:, index]
        return rows.reshape(-1, *shape[1:])

    return built(part, values)


def without_depth(
    view: View, depths: Float32 | Float64, what: str, *, visible: bool = False
) -> View:
    """Return a view whose points have a depth that is constant, or is MediaPipe's guess.

    Parameters
    ----------
    depths
        Of all points, in any shape.
    visible
        Whether there is a visibility, a name that only MediaPipe uses.

    Raises
    ------
    FormatError
        If the depth makes the points 3D.
    """
    if not any(np.any(np.nan_to_num(depths[block])) for block in blocks(depths)):
        return view
    count = inside = 0
    for block in blocks(view.keypoints):
        known = view.keypoints[block][located(view.keypoints[block])]
        count += known.size
        inside += int(((known >= 0) & (known <= 1)).sum())
    shares = inside > INSIDE * count
    names = view.keypoint_names
    landmarks = (
        view.keypoints.shape[2] in MANY_OF_MEDIAPIPE
        if names is None
        else OF_MEDIAPIPE.issuperset(map(plain, names))
    )
    if not (visible or (shares and landmarks)):
        raise FormatError(f"{OF_3D}", place=what)
    note = "the z of landmarks is a guess of one image, and was left out"
    return replace(view, notes=(*view.notes, note))


def bounded_columns(count: int, what: str) -> None:
    """Refuse a table of more columns than people have keypoints; `what` names its file."""
    if count > MAX_COLUMNS:
        raise FormatError(
            f"has {count:,} columns, more than the {MAX_COLUMNS:,} that are read; "
            "leave out those that hold no keypoints",
            place=what,
        )


def row_numbers(rows: Sequence[object], what: str) -> Int64:
    """Return frame numbers from what names the rows: numbers, or paths of images, in any order.

    Rows of images are counted from 0 where a name gives no number, or two give the same.

    Raises
    ------
    FormatError
        If a number is there twice; `what` names the file in it.
    """
    texts = [row.decode("utf-8", "replace") if isinstance(row, bytes) else str(row) for row in rows]
    if all(_WHOLE.fullmatch(text) for text in texts):
        numbers = np.array([int(text.partition(".")[0]) for text in texts], np.int64)
        once, count = np.unique(numbers, return_counts=True)
        if len(once) < len(numbers):
            raise FormatError(
                f"has frame {once[count > 1][0]} twice; give a file for each camera", place=what
            )
        return numbers
    split = [frame_number(text if "." in text else f"{text}.") for text in texts]
    found = [each[1] for each in split if each is not None]
    return np.array(found, np.int64) if len(set(found)) == len(rows) else np.arange(len(rows))
