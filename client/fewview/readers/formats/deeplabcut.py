"""DeepLabCut: CSV and H5, of one or several animals, detected or labelled; Anipose's are the same.

A column has a scorer, an individual (where there are several animals), a body part and a
coordinate: x, y, likelihood.
"""

import csv
import io

from fewview.errors import FormatError
from fewview.readers.columns import Label, numbers_of_cells, row_numbers, view_of_columns
from fewview.readers.pandas_h5 import read_table
from fewview.readers.sources import Source
from fewview.readers.views import View

LEVELS = ("scorer", "individuals", "bodyparts", "coords")


def fits_h5(source: Source) -> bool:
    """Whether pandas wrote a table into this HDF5 file."""
    return any(source.hdf5.values())


def fits_csv(source: Source) -> bool:
    """Whether rows of scorers, body parts and coordinates are above the table."""
    return {"bodyparts", "coords"} <= {line.partition(",")[0] for line in source.lines[:4]}


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
    numbers = row_numbers([row[-1] if isinstance(row, tuple) else row for row in rows])
    return [view_of_columns(_name(source), _labels(texts, names), values, numbers, str(source))]


def read_csv(source: Source) -> list[View]:
    """Return the view of a CSV file.

    Raises
    ------
    FormatError
        If its rows are of unlike length or hold no numbers.
    """
    rows = [row for row in csv.reader(io.StringIO(source.text())) if row]
    count = 1 + next(i for i, row in enumerate(rows) if row[0] == "coords")
    header, body = rows[:count], rows[count:]
    coordinates = [cell.strip() for cell in header[-1]]
    # One column names the frames; labelled images have up to three: folder, video, image.
    first = next((i for i, cell in enumerate(coordinates) if i and cell), len(coordinates))
    levels = [row[0].lower() for row in header]
    texts = list(zip(*(row[first:] for row in header), strict=True))
    if any(len(row) != len(header[0]) for row in body):
        raise FormatError(f"{source}: rows are of unlike length")
    values = numbers_of_cells([row[first:] for row in body], str(source))
    values = values.reshape(len(body), len(texts))
    numbers = row_numbers([_number(row[first - 1]) for row in body])
    return [view_of_columns(_name(source), _labels(texts, levels), values, numbers, str(source))]


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


def _number(cell: str) -> int | str:
    return int(cell) if cell.isdigit() else cell


def _name(source: Source) -> str:
    """Return the video's name: what follows ``DLC_`` names the network."""
    return source.name.partition("DLC_")[0].rstrip("_") or source.name
