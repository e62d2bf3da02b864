"""Plain tables: a row for each frame, or for each keypoint of a frame.

Wide: columns ``nose_x``, ``nose_y``, ``nose_confidence`` (or ``.``, or ``x_nose``, ``x1``), as
SLEAP, MediaPipe's users, DLTdv and many scripts write them. Tidy: columns ``keypoint``, ``x``,
``y``, ``confidence``. Both may have columns of the frame, the time, the camera and the person. Rows
of one frame without a person's name are people in a list without order, and so are columns
``inst0.nose.x`` of sleap-io.
"""

import re
from dataclasses import replace

import numpy as np

from fewview.capture import Float32, Float64
from fewview.errors import FormatError
from fewview.readers.clocks import seconds_in
from fewview.readers.columns import bounded_columns, row_numbers, views_of_columns
from fewview.readers.file_names import natural
from fewview.readers.headers import Columns, Label, columns_of, mapped_columns
from fewview.readers.large_arrays import blocks, built, rows_of
from fewview.readers.separated import Table, Words, read_columns, table_of
from fewview.readers.sources import Source
from fewview.readers.views import Int64, View, bounded

_OF_ALL = re.compile(r"inst\d+\.|instance[._ ]|track_?|tracking_|score$", re.IGNORECASE)
_SUFFIX = re.compile(r"\.\w{2,4}$")
_PLACE = re.compile(r"(inst\d+)\.(.+)")


def fits(source: Source) -> bool:
    """Whether the header names an x and a y."""
    table = table_of(source)
    return table is not None and columns_of(table.header[0]).has_points


def read(source: Source, mapping: str | None = None) -> list[View]:
    """Return the views of a file, one for each camera that it names.

    Parameters
    ----------
    mapping
        The contents of columns, as `ReadingOptions.columns`; None: from their names.

    Raises
    ------
    FormatError
        If its rows differ in length or have no numbers, two rows are the same keypoint, or it is
        unknown which rows are of one frame.
    """
    table = table_of(source)
    if table is None:
        raise FormatError("no table with a header", place=source)
    header = table.header[0]
    bounded_columns(len(header), str(source))
    columns = columns_of(header) if mapping is None else mapped_columns(header, mapping)
    if not columns.has_points:
        raise FormatError("has no columns of x and y", place=source, option="columns")
    if columns.roles.keys() & {"person", "keypoint"} and not (
        columns.roles.keys() & {"frame", "time"}
    ):
        raise FormatError("has no column `frame` or `time` that joins its rows", place=source)
    return _read(source, table, columns)


def _read(source: Source, table: Table, columns: Columns) -> list[View]:
    roles, labels = columns.roles, columns.labels
    texts, values = read_columns(table, texts=list(roles.values()), numbers=list(labels))
    if not len(values):
        raise FormatError("no rows", place=source)
    given = dict(zip(roles, texts, strict=True))
    header = table.header[0]
    known = {*labels, *roles.values()}
    nowhere = [
        cell
        for place, cell in enumerate(header)
        if place not in known and cell and not _OF_ALL.match(cell)
    ]
    notes = (f"columns that were not understood: {', '.join(nowhere[:6])}",) if nowhere else ()
    clock = header[roles["time"]] if "time" in roles else ""
    cameras = given.pop("camera", Words(("",), np.zeros(len(values), np.int64)))
    views = []
    for code, name in sorted(enumerate(cameras.words), key=lambda each: natural(each[1])):
        mine = cameras.codes == code
        own = {role: replace(words, codes=words.codes[mine]) for role, words in given.items()}
        for view in _views(source, list(labels.values()), rows_of(values, mine), own, clock):
            called = view.name or _stem(name) or source.name
            views.append(replace(view, name=called, notes=(*view.notes, *notes)))
    return views


def _stem(name: str) -> str:
    """Return the name of a camera, of its video where a path is given."""
    return _SUFFIX.sub("", name.replace("\\", "/").rsplit("/", 1)[-1])


def _views(
    source: Source,
    columns: list[Label],
    values: Float32,
    given: dict[str, Words],
    clock: str,
) -> list[View]:
    """Pivot the rows of one camera to one for each frame."""
    nothing = Words(("",), np.zeros(len(values), np.int64))
    frames, numbers, times = _frames(source, given, len(values), clock)
    points = given.get("keypoint", nothing)
    people = given.get("person", nothing)
    cell = frames * len(points.words) + points.codes
    own, count = np.unique(cell * len(people.words) + people.codes, return_counts=True)
    twice = {people.words[place] for place in own[count > 1] % len(people.words)}
    if any(twice):
        who = next(filter(None, sorted(twice)))
        raise FormatError(f"has {who!r} twice in the same frame", place=source)
    if twice:  # rows without a person's name
        places = _turns(cell)
        people = Words(tuple(map(str, range(int(places.max()) + 1))), places)
    shape = (len(numbers), len(people.words), len(points.words), len(columns))
    bounded(shape, str(source))
    bounded_columns(len(people.words) * len(points.words) * len(columns), str(source))
    table = _pivoted(values, shape, frames, people.codes, points.codes)
    labels: list[Label] = []
    listed = bool(twice)
    for person in people.words:
        for point in points.words:
            for column in columns:
                place = _PLACE.fullmatch(column.keypoint)
                listed |= place is not None
                who, what = (
                    (f"{person}{place[1]}", place[2]) if place else (person, column.keypoint)
                )
                labels.append(column._replace(person=who, keypoint=point or what))
    views = views_of_columns("", labels, table, numbers, str(source))
    return [replace(view, people=None if listed else view.people, times=times) for view in views]


def _pivoted(
    values: Float32, shape: tuple[int, ...], frames: Int64, people: Int64, points: Int64
) -> Float32:
    """Return the rows (R, C) at their frames, people and points, as (N, M * P * C), NaN elsewhere.

    Parameters
    ----------
    shape
        N, M, P and C.
    frames, people, points
        (R,) of each row.
    """
    if shape[1:3] == (1, 1) and np.array_equal(frames, np.arange(shape[0])):
        return values  # a row for each frame, in order
    every = np.arange(shape[0])
    table = built(lambda block: np.full((len(every[block]), *shape[1:]), np.nan, np.float32), every)
    for block in blocks(values, table):
        table[frames[block], people[block], points[block]] = values[block]
    return table.reshape(len(table), -1)


def _turns(cell: Int64) -> Int64:
    """Return how many rows before each (N,) are of the same cell."""
    order = np.argsort(cell, kind="stable")
    rising = cell[order]
    first = np.flatnonzero(np.diff(rising, prepend=-1))
    turns = np.empty(len(cell), np.int64)
    turns[order] = np.arange(len(cell)) - np.repeat(first, np.diff(first, append=len(cell)))
    return turns


def _frames(
    source: Source, given: dict[str, Words], rows: int, clock: str
) -> tuple[Int64, Int64, Float64 | None]:
    """Return the frame (N,) of each row, and numbers and times of the frames.

    Times in a column called `clock` count as the frames where there are no numbers.
    """
    seconds = seconds_in(given["time"], clock) if "time" in given else None
    words = given.get("frame", given.get("time"))
    if words is None:
        return np.arange(rows), np.arange(rows), None
    named = _as_numbers(words) if "frame" in given or seconds is None else seconds
    if named is None:
        codes, frames = np.unique(words.codes, return_inverse=True)
        names = [words.words[code] for code in codes]
        order = np.array(sorted(range(len(names)), key=lambda place: natural(names[place])))
        numbers = row_numbers([names[place] for place in order], str(source))
        rising = np.argsort(numbers, kind="stable")
        order, numbers = order[rising], numbers[rising]
        frames = np.argsort(order)[frames]
    else:
        known, frames = np.unique(named, return_inverse=True)
        if np.isnan(known).any():
            raise FormatError("has a row without a frame", place=source)
        whole = "frame" in given and (known == np.round(known)).all()
        numbers = known.astype(np.int64) if whole else np.arange(len(known))
    if seconds is None:
        return frames, numbers, None
    times = np.empty(len(numbers))
    times[frames] = seconds
    return frames, numbers, times if np.isfinite(times).all() else None


def _as_numbers(words: Words) -> Float64 | None:
    """Return the number (N,) of each row; None where a word is no number."""
    try:
        return np.array([float(word or "nan") for word in words.words])[words.codes]
    except ValueError:
        return None
