"""DeepLabCut: CSV and H5, of one or several animals, detected or labelled; Anipose's are the same.

A column has a scorer, an individual (where there are several animals), a body part and a
coordinate: x, y, likelihood.
"""

from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers.columns import COORDINATES, Label, row_numbers, view_of_columns
from fewview.readers.pandas_h5 import read_table
from fewview.readers.separated import cells, read_columns
from fewview.readers.sources import Source
from fewview.readers.views import Int64, View

UNIQUE = "single"  # the individual that DeepLabCut gives to points of the scene
BONES = "_skeleton"  # ends the names of files of lengths and angles beside those of detections
LEVELS = ("scorer", "individuals", "bodyparts", "coords")


def fits_h5(source: Source) -> bool:
    """Whether pandas wrote a table into this HDF5 file."""
    return any(source.hdf5.values()) and not source.name.endswith(BONES)


def fits_csv(source: Source) -> bool:
    """Whether rows of scorers, body parts and coordinates are above the table."""
    heads = {line.partition(",")[0] for line in source.lines[:4]}
    return {"bodyparts", "coords"} <= heads and not source.name.endswith(BONES)


def read_h5(source: Source) -> list[View]:
    """Return the view of an H5 file.

    Raises
    ------
    FormatError
        If the table's columns are not those of DeepLabCut.
    """
    columns, levels, values, rows = read_table(source)
    if not columns or len(columns[0]) not in (2, 3, 4):
        raise FormatError(f"{source}: a table of pandas, its columns are not those of DeepLabCut")
    texts = [tuple(map(str, column)) for column in columns]
    names = [str(level).lower() for level in levels]
    if not {"bodyparts", "coords"} <= set(names):
        names = list(LEVELS if len(texts[0]) == 4 else LEVELS[:1] + LEVELS[2:])[-len(texts[0]) :]
    numbers = row_numbers([row[-1] if isinstance(row, tuple) else row for row in rows], str(source))
    return [_view(source, _labels(texts, names), values, numbers)]


def read_csv(source: Source) -> list[View]:
    """Return the view of a CSV file.

    Raises
    ------
    FormatError
        If its rows are of unlike length or hold no numbers.
    """
    header: list[list[str]] = []
    for line in islice(source.text_lines(), len(LEVELS)):
        header.append(cells(line, ","))
        if header[-1][0] == "coords":
            break
    coordinates = [cell.lower() for cell in header[-1]]
    # One column names the frames; labelled images have up to three: folder, video, image.
    first = next((i for i, cell in enumerate(coordinates) if i and cell), len(coordinates))
    # Others, such as `set` of Lightning Pose, need not hold numbers.
    wanted = [i for i in range(first, len(coordinates)) if coordinates[i] in (*COORDINATES, "z")]
    (frames,), values = read_columns(
        source, len(header), ",", len(header[-1]), texts=[first - 1], numbers=wanted
    )
    levels = [row[0].lower() for row in header]
    labels = _labels([tuple(row[i] for row in header) for i in wanted], levels)
    return [_view(source, labels, values, row_numbers(frames.rows(), str(source)))]


def _view(source: Source, labels: list[Label], values: NDArray[np.float64], numbers: Int64) -> View:
    """Return the view of a table; points that belong to no animal are left out."""
    animals = {label[1] for label in labels if label[0] != UNIQUE}
    others = list(dict.fromkeys(label[1] for label in labels if label[0] == UNIQUE))
    notes: tuple[str, ...] = ()
    if animals and others and not animals & set(others):
        kept = [i for i, label in enumerate(labels) if label[0] != UNIQUE]
        labels, values = [labels[i] for i in kept], values[:, kept]
        notes = (f"{', '.join(others)} left out, as they belong to no animal",)
    view = view_of_columns(_name(source), labels, values, numbers, str(source))
    return replace(view, notes=notes)


def _labels(columns: list[tuple[str, ...]], levels: list[str]) -> list[Label]:
    place = {level: index for index, level in enumerate(levels)}
    person = place.get("individuals")
    return [
        (
            "" if person is None else column[person],
            column[place["bodyparts"]],
            column[place["coords"]].lower(),
        )
        for column in columns
    ]


def _name(source: Source) -> str:
    """Return the video's name: what follows ``DLC_`` names the network."""
    return source.name.partition("DLC_")[0].rstrip("_") or source.name
