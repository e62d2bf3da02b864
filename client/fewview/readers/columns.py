"""Tables with a column for each x, y and confidence, as views: of CSV and of HDF5 by pandas."""

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
    "p": 2,
}
Label = tuple[str, str, str]  # individual ("" if there is one), keypoint, coordinate


def view_of_columns(
    name: str, labels: Sequence[Label], values: NDArray[np.float64], numbers: Int64, what: str
) -> View:
    """Return the view of a table.

    Parameters
    ----------
    labels
        C columns: the individual ("" if there is one), the keypoint, the coordinate. Columns whose
        coordinate is not known are left out.
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
    people = tuple(dict.fromkeys(label[0] for label in labels))
    points = tuple(dict.fromkeys(label[1] for label in labels if label[2] in COORDINATES))
    axes = {label[2] for label in labels}
    if "z" in axes:
        raise FormatError(
            f"{what}: has columns of x, y and z, so it holds 3D points; Fewview makes 3D from the "
            "2D keypoints of each camera: give those"
        )
    if not {"x", "y"} <= axes:
        raise FormatError(f"{what}: has no columns of x and y")
    shape = (len(values), len(people), len(points), 3)
    bounded(shape, what)
    out = np.full(shape, np.nan, np.float32)
    place = {person: i for i, person in enumerate(people)}
    point = {keypoint: i for i, keypoint in enumerate(points)}
    told = False
    for column, (person, keypoint, axis) in enumerate(labels):
        if axis in COORDINATES:
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


def row_numbers(rows: Sequence[object]) -> Int64:
    """Return frame numbers from what names the rows: numbers, or paths of images.

    Rows whose names give no rising numbers are counted from 0.
    """
    numbers = np.arange(len(rows))
    found: list[int] = []
    for row in rows:
        if isinstance(row, int | float | np.number) and float(row).is_integer():
            found.append(int(row))
            continue
        text = row.decode("utf-8", "replace") if isinstance(row, bytes) else str(row)
        split = frame_number(text if "." in text else f"{text}.")
        if split is None:
            return numbers
        found.append(split[1])
    if found and np.all(np.diff(found) > 0):
        numbers = np.array(found)
    return numbers.astype(np.int64)


def numbers_of_cells(cells: Sequence[Sequence[str]], what: str) -> NDArray[np.float64]:
    """Return rows of text as numbers (N, C); empty cells are NaN.

    Raises
    ------
    FormatError
        If rows are of unlike length, or a cell holds no number.
    """
    try:
        return np.array(
            [[float(cell) if cell.strip() else np.nan for cell in row] for row in cells], np.float64
        )
    except ValueError as error:
        raise FormatError(f"{what}: not a table of numbers ({error})") from error
