"""Plain CSV: a row for each frame, or for each keypoint of a frame.

Wide: columns ``nose_x``, ``nose_y``, ``nose_confidence`` (or ``.``, or ``x_nose``), as SLEAP and
many scripts write them. Tidy: columns ``keypoint``, ``x``, ``y``, ``confidence``. Both may have
columns of the frame, the time, the camera and the person. Rows of one frame that name nobody are
people in a list without order, and so are columns ``inst0.nose.x`` of sleap-io.
"""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fewview.capture import Float64
from fewview.errors import FormatError
from fewview.readers.columns import (
    COORDINATES,
    Label,
    bounded_columns,
    row_numbers,
    view_of_columns,
)
from fewview.readers.names import natural
from fewview.readers.separated import Words, cells, read_columns, separator
from fewview.readers.sources import Source
from fewview.readers.views import Int64, View, bounded

ROLES = {
    "frame": ("frame", "frame_idx", "frame_id", "frame_number", "fnum", "index", ""),
    "time": ("time", "times", "timestamp", "time_s", "seconds", "t"),
    "camera": ("camera", "cam", "view", "video", "video_path"),
    "person": ("person", "track", "individual", "animal", "id", "person_id"),
    "keypoint": ("keypoint", "bodypart", "joint", "landmark", "marker", "node"),
}
_AXIS = "|".join((*COORDINATES, "z"))
_WIDE = re.compile(rf"^(.+?)[._ ]({_AXIS})$", re.IGNORECASE)
_TURNED = re.compile(r"^([xyz])[._ ](.+)$", re.IGNORECASE)
_OF_ALL = re.compile(r"inst\d+\.|instance[._ ]|track_?|tracking_|score$", re.IGNORECASE)
_PLACE = re.compile(r"(inst\d+)\.(.+)")


def fits(source: Source) -> bool:
    """Whether the header names an x and a y."""
    if not source.lines:
        return False
    header = cells(source.lines[0], separator(source.lines[0]))
    axes = {axis for _, axis in _columns(header).values()}
    return {"x", "y"} <= axes and (_roles(header).keys() >= {"keypoint"} or _wide(header))


def read(source: Source) -> list[View]:
    """Return the views of a file, one for each camera that it names.

    Raises
    ------
    FormatError
        If its rows are of unlike length or hold no numbers, a row tells what another has told, or
        nothing tells which rows are of one frame.
    """
    head = next(source.text_lines())
    header = cells(head, separator(head))
    bounded_columns(len(header), str(source))
    roles, columns = _roles(header), _columns(header)
    if roles.keys() & {"person", "keypoint"} and not roles.keys() & {"frame", "time"}:
        raise FormatError(f"{source}: has no column `frame` or `time` that joins its rows")
    texts, values = read_columns(
        source, 1, separator(head), len(header), texts=list(roles.values()), numbers=list(columns)
    )
    if not len(values):
        raise FormatError(f"{source}: no rows")
    told = dict(zip(roles, texts, strict=True))
    known = {*columns, *roles.values()}
    nowhere = [
        cell
        for place, cell in enumerate(header)
        if place not in known and cell and not _OF_ALL.match(cell)
    ]
    notes = (f"columns that were not understood: {', '.join(nowhere[:6])}",) if nowhere else ()
    cameras = told.pop("camera", Words(("",), np.zeros(len(values), np.int64)))
    views = []
    for code, name in sorted(enumerate(cameras.words), key=lambda each: natural(each[1])):
        mine = cameras.codes == code
        own = {role: replace(words, codes=words.codes[mine]) for role, words in told.items()}
        view = _view(source, list(columns.values()), values[mine], own)
        views.append(replace(view, name=_stem(name) or source.name, notes=notes))
    return views


def _stem(name: str) -> str:
    """Return the name of a camera, of its video where a path was told."""
    return re.sub(r"\.\w{2,4}$", "", name.replace("\\", "/").rsplit("/", 1)[-1])


def _view(
    source: Source,
    columns: list[tuple[str, str]],
    values: NDArray[np.float64],
    told: dict[str, Words],
) -> View:
    """Pivot the rows of one camera to one for each frame."""
    nothing = Words(("",), np.zeros(len(values), np.int64))
    frames, numbers, times = _frames(source, told, len(values))
    points = told.get("keypoint", nothing)
    people = told.get("person", nothing)
    cell = frames * len(points.words) + points.codes
    own, count = np.unique(cell * len(people.words) + people.codes, return_counts=True)
    twice = {people.words[place] for place in own[count > 1] % len(people.words)}
    if any(twice):
        who = next(filter(None, sorted(twice)))
        raise FormatError(f"{source}: tells of {who!r} twice in the same frame")
    if twice:  # rows that name nobody
        places = _turns(cell)
        people = Words(tuple(map(str, range(int(places.max()) + 1))), places)
    shape = (len(numbers), len(people.words), len(points.words), len(columns))
    bounded(shape, str(source))
    bounded_columns(len(people.words) * len(points.words) * len(columns), str(source))
    table = np.full(shape, np.nan)
    table[frames, people.codes, points.codes] = values
    labels: list[Label] = []
    listed = bool(twice)
    for person in people.words:
        for point in points.words:
            for keypoint, axis in columns:
                place = _PLACE.fullmatch(keypoint)
                listed |= place is not None
                who, what = (f"{person}{place[1]}", place[2]) if place else (person, keypoint)
                labels.append((who, point or what, axis))
    view = view_of_columns("", labels, table.reshape(len(table), -1), numbers, str(source))
    return replace(view, people=None if listed else view.people, times=times)


def _turns(cell: Int64) -> Int64:
    """Return how many rows before each (N,) are of the same cell."""
    order = np.argsort(cell, kind="stable")
    rising = cell[order]
    first = np.flatnonzero(np.diff(rising, prepend=-1))
    turns = np.empty(len(cell), np.int64)
    turns[order] = np.arange(len(cell)) - np.repeat(first, np.diff(first, append=len(cell)))
    return turns


def _frames(
    source: Source, told: dict[str, Words], rows: int
) -> tuple[Int64, Int64, Float64 | None]:
    """Return the frame (N,) of each row, and numbers and times of the frames."""
    words = told.get("frame", told.get("time"))
    if words is None:
        return np.arange(rows), np.arange(rows), None
    named = _as_numbers(words)
    if named is None:
        codes, frames = np.unique(words.codes, return_inverse=True)
        names = [words.words[code] for code in codes]
        order = np.array(sorted(range(len(names)), key=lambda place: natural(names[place])))
        numbers = row_numbers([names[place] for place in order], str(source))
        frames = np.argsort(order)[frames]
    else:
        known, frames = np.unique(named, return_inverse=True)
        if np.isnan(known).any():
            raise FormatError(f"{source}: has a row that tells no frame")
        whole = "frame" in told and (known == np.round(known)).all()
        numbers = known.astype(np.int64) if whole else np.arange(len(known))
    clock = _as_numbers(told["time"]) if "time" in told else None
    if clock is None:
        return frames, numbers, None
    times = np.empty(len(numbers))
    times[frames] = clock
    return frames, numbers, times if np.isfinite(times).all() else None


def _as_numbers(words: Words) -> Float64 | None:
    """Return the number (N,) of each row; None where a word is no number."""
    try:
        return np.array([float(word or "nan") for word in words.words])[words.codes]
    except ValueError:
        return None


def _roles(header: Sequence[str]) -> dict[str, int]:
    lower = [cell.lower() for cell in header]
    roles = {
        role: lower.index(name)
        for role, names in ROLES.items()
        for name in reversed(names)
        if name in lower
    }
    if not roles.keys() & {"frame", "time"} and lower[roles.get("person", 0)] == "id":
        roles["frame"] = roles.pop("person")
    return roles


def _columns(header: Sequence[str]) -> dict[int, tuple[str, str]]:
    """Return of each column with a coordinate its keypoint ("" in a tidy table) and its axis."""
    roles = _roles(header)
    tidy, others = "keypoint" in roles, set(roles.values())
    found: dict[int, tuple[str, str]] = {}
    for index, cell in enumerate(header):
        if tidy:
            if cell.lower() in (*COORDINATES, "z"):
                found[index] = ("", cell.lower())
        elif index not in others:
            if match := _WIDE.match(cell):
                found[index] = (match[1], match[2].lower())
            elif match := _TURNED.match(cell):
                found[index] = (match[2], match[1].lower())
    return {i: said for i, said in found.items() if said[0].lower() != "instance"}


def _wide(header: Sequence[str]) -> bool:
    columns = set(_columns(header).values())
    return any((name, "x") in columns and (name, "y") in columns for name, _ in columns)
