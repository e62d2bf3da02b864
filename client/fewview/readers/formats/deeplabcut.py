"""DeepLabCut: tables and H5, of one or several animals, detected or labelled; so are Anipose's.

A column has a scorer, an individual (where there are several animals), a body part and a
coordinate: x, y, likelihood. JARVIS writes such rows without names of their own, down to that of
coordinates alone.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float32, Float64
from fewview.errors import FormatError
from fewview.readers.columns import row_numbers, views_of_columns
from fewview.readers.headers import LEVELS, Label, axis_of, parted, stacked_columns
from fewview.readers.large_arrays import in_order, rows_of, taken
from fewview.readers.pandas_h5 import read_table
from fewview.readers.separated import Table, Words, read_columns, table_of
from fewview.readers.sources import Source
from fewview.readers.views import Int64, View

UNIQUE = "single"  # the individual that DeepLabCut gives to points of the scene
BONES = "_skeleton"  # ends the names of files of lengths and angles beside those of detections
TIMES = ("frame_time", "pose_time")  # of DeepLabCut Live: when an image was taken, and seen


def fits_h5(source: Source) -> bool:
    """Whether pandas wrote a table into this HDF5 file."""
    return any(source.hdf5.values()) and not source.name.endswith(BONES)


def fits_csv(source: Source) -> bool:
    """Whether rows of scorers, body parts and coordinates are above the table."""
    table = _stacked(source)
    return table is not None and (
        len(table.header) > 2 or "coords" in {row[0].lower() for row in table.header}
    )


def fits_jarvis(source: Source) -> bool:
    """Whether a row of coordinates is above the table, under one of names or none."""
    return _stacked(source) is not None and not fits_csv(source)


def _stacked(source: Source) -> Table | None:
    """Return the table whose header ends in a row of coordinates."""
    table = None if source.name.endswith(BONES) else table_of(source)
    if table is None:
        return None
    repeated = [axis_of(cell) for cell in table.header[-1]].count("x") > 1
    named = any(row[0].lower() == "coords" for row in table.header)
    return table if named or repeated or len(table.header) > 2 else None


def read_h5(source: Source) -> list[View]:
    """Return the view of an H5 file.

    Raises
    ------
    FormatError
        If the table's columns are not those of DeepLabCut.
    """
    columns, levels, values, rows = read_table(source)
    if not columns or len(columns[0]) not in (2, 3, 4):
        raise FormatError(
            "a table of pandas, its columns are not those of DeepLabCut", place=source
        )
    texts = [tuple(map(str, column)) for column in columns]
    names = [str(level).lower() for level in levels]
    if not {"bodyparts", "coords"} <= set(names):
        names = list(LEVELS if len(texts[0]) == 4 else LEVELS[:1] + LEVELS[2:])[-len(texts[0]) :]
    numbers = row_numbers([row[-1] if isinstance(row, tuple) else row for row in rows], str(source))
    place = {level: index for index, level in enumerate(names)}
    part, axis, person = place["bodyparts"], place["coords"], place.get("individuals")
    labels = {
        column: Label("", "" if person is None else each[person], each[part], known)
        for column, each in enumerate(texts)
        if (known := axis_of(each[axis]))
    }
    clocks = [i for name in TIMES for i, each in enumerate(texts) if name in each]
    times = values[:, clocks[0]] if clocks and np.isfinite(values[:, clocks[0]]).all() else None
    return _views(source, parted(labels), values[:, list(labels)], numbers, times)


def read_csv(source: Source) -> list[View]:
    """Return the views of a table.

    Raises
    ------
    FormatError
        If its rows are of unlike length or hold no numbers.
    """
    table = _stacked(source)
    if table is None:
        raise FormatError("no table under rows of names and coordinates", place=source)
    columns = stacked_columns(table.header)
    # Others, such as `set` of Lightning Pose, need not hold numbers.
    texts, values = read_columns(
        table, texts=list(columns.roles.values()), numbers=list(columns.labels)
    )
    numbers = np.arange(len(values))
    if texts:
        numbers, kept = _numbers(texts[0], str(source))
        values = rows_of(values, kept)
    return _views(source, columns.labels, values, numbers)


def _numbers(frames: Words, what: str) -> tuple[Int64, NDArray[np.bool_]]:
    """Return the frame numbers, and which rows (N,) are those of frames: not a line of totals."""
    rows = frames.rows()
    kept = np.array([bool(row) for row in rows], bool)
    return row_numbers([row for row in rows if row], what), kept


def _views(
    source: Source,
    columns: dict[int, Label],
    values: Float32 | Float64,
    numbers: Int64,
    times: Float64 | None = None,
) -> list[View]:
    """Return the views of a table, in the order of its frame numbers.

    Points that belong to no animal are left out.
    """
    if np.any(np.diff(numbers) < 0):
        order = np.argsort(numbers, kind="stable")
        values, numbers = in_order(values, order), numbers[order]
        times = None if times is None else times[order]
    labels = list(columns.values())
    animals = {label.keypoint for label in labels if label.person != UNIQUE}
    others = list(dict.fromkeys(label.keypoint for label in labels if label.person == UNIQUE))
    notes: tuple[str, ...] = ()
    if animals and others and not animals & set(others):
        kept = [i for i, label in enumerate(labels) if label.person != UNIQUE]
        labels, values = [labels[i] for i in kept], taken(values, kept, axis=1)
        notes = (f"{', '.join(others)} left out, as they belong to no animal",)
    views = views_of_columns(_name(source), labels, values, numbers, str(source))
    return [replace(view, times=times, notes=(*view.notes, *notes)) for view in views]


def _name(source: Source) -> str:
    """Return the video's name: what follows ``DLC_`` names the network."""
    return source.name.partition("DLC_")[0].rstrip("_") or source.name
