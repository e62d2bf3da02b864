"""Tables with a column for each x, y and confidence, as views: of CSV and of HDF5 by pandas."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers.names import frame_number
from fewview.readers.views import Int64, View, bounded

COORDINATES = {
    "x": 0,
    "y": 1,
    "likelihood": 2,
    "confidence": 2,
    "conf": 2,
    "score": 2,
    "visibility": 2,
    "probability": 2,
    "prob": 2,
    "p": 2,
}
MAX_COLUMNS = 2**16  # of a table: 21,845 keypoints with their confidence
Label = tuple[str, str, str]  # individual ("" if there is one), keypoint, coordinate


def view_of_columns(
    name: str, labels: Sequence[Label], values: NDArray[np.float64], numbers: Int64, what: str
) -> View:
    """Return the view of a table.

    Parameters
    ----------
    labels
        C columns: the individual ("" if there is one), the keypoint, the coordinate. Columns whose
        coordinate is not known are left out, and keypoints without an x or a y.
    values
        (N, C).
    numbers
        (N,) number of each frame.
    what
        Names the file in errors.

    Raises
    ------
    FormatError
        If there are no columns of x and y, or there are z.
    """
    bounded_columns(len(labels), what)
    people = tuple(dict.fromkeys(label[0] for label in labels))
    axes = {label[2] for label in labels}
    with_x, with_y = ({label[1] for label in labels if label[2] == axis} for axis in "xy")
    whole = with_x & with_y
    points = tuple(dict.fromkeys(label[1] for label in labels if label[1] in whole))
    if "z" in axes:
        raise FormatError(
            f"{what}: has columns of x, y and z, so it holds 3D points; Fewview makes 3D from the "
            "2D keypoints of each camera: give those"
        )
    if not points:
        raise FormatError(f"{what}: has no columns of x and y")
    shape = (len(values), len(people), len(points), 3)
    bounded(shape, what)
    out = np.full(shape, np.nan, np.float32)
    place = {person: i for i, person in enumerate(people)}
    point = {keypoint: i for i, keypoint in enumerate(points)}
    told = False
    for column, (person, keypoint, axis) in enumerate(labels):
        if axis in COORDINATES and keypoint in point:
            out[:, place[person], point[keypoint], COORDINATES[axis]] = values[:, column]
            told |= COORDINATES[axis] == 2
    return View(
        name,
        out[..., :2],
        numbers,
        out[..., 2] if told else None,
        people=people,
        keypoint_names=points,
    )


def bounded_columns(count: int, what: str) -> None:
    """Refuse a table of more columns than people have keypoints; `what` names its file."""
    if count > MAX_COLUMNS:
        raise FormatError(
            f"{what}: has {count:,} columns, more than the {MAX_COLUMNS:,} that are read; "
            "leave out those that hold no keypoints"
        )


def row_numbers(rows: Sequence[object], what: str) -> Int64:
    """Return frame numbers from what names the rows: numbers, or paths of images.

    Rows of images whose names give no rising numbers are counted from 0.

    Raises
    ------
    FormatError
        If a number is there twice; `what` names the file in it.
    """
    texts = [row.decode("utf-8", "replace") if isinstance(row, bytes) else str(row) for row in rows]
    if all(re.fullmatch(r"\d{1,18}(\.0*)?", text) for text in texts):
        numbers = np.array([int(text.partition(".")[0]) for text in texts], np.int64)
        once, count = np.unique(numbers, return_counts=True)
        if len(once) < len(numbers):
            raise FormatError(
                f"{what}: tells of frame {once[count > 1][0]} twice; give a file for each camera"
            )
        return numbers if (once == numbers).all() else np.arange(len(rows))
    split = [frame_number(text if "." in text else f"{text}.") for text in texts]
    found = [each[1] for each in split if each is not None]
    if len(found) < len(rows) or np.any(np.diff(found) <= 0):
        return np.arange(len(rows))
    return np.array(found, np.int64)
