"""Plain CSV: a row for each frame, or for each keypoint of a frame.

Wide: columns ``nose_x``, ``nose_y``, ``nose_confidence`` (or ``.``, or ``x_nose``), as SLEAP and
many scripts write them. Tidy: columns ``keypoint``, ``x``, ``y``, ``confidence``. Both may have
columns of the frame, the time, the camera and the person.
"""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fewview.errors import FormatError
from fewview.readers.columns import (
    COORDINATES,
    Label,
    numbers_of_cells,
    row_numbers,
    view_of_columns,
)
from fewview.readers.names import natural
from fewview.readers.sources import Source
from fewview.readers.views import View

ROLES = {
    "frame": ("frame", "frame_idx", "frame_id", "frame_number", "fnum", "index", ""),
    "time": ("time", "times", "timestamp", "time_s", "seconds", "t"),
    "camera": ("camera", "cam", "view"),
    "person": ("person", "track", "individual", "animal", "id", "person_id"),
    "keypoint": ("keypoint", "bodypart", "joint", "landmark", "marker", "node"),
}
_AXIS = "|".join((*COORDINATES, "z"))
_WIDE = re.compile(rf"^(.+?)[._ ]({_AXIS})$", re.IGNORECASE)
_TURNED = re.compile(r"^([xyz])[._ ](.+)$", re.IGNORECASE)
Row = list[str]


def fits(source: Source) -> bool:
    """Whether the header names an x and a y."""
    if not source.lines:
        return False
    header = _cells(source.lines[0])
    axes = {axis for _, axis in _columns(header).values()}
    return {"x", "y"} <= axes and (_roles(header).keys() >= {"keypoint"} or _wide(header))


def read(source: Source) -> list[View]:
    """Return the views of a file, one for each camera that it names.

    Raises
    ------
    FormatError
        If its rows are of unlike length or hold no numbers.
    """
    text = source.text()
    header = _cells(text.partition("\n")[0])
    rows = list(csv.reader(io.StringIO(text), delimiter=_delimiter(text)))[1:]
    rows = [[cell.strip() for cell in row] for row in rows if row]
    if any(len(row) != len(header) for row in rows) or not rows:
        raise FormatError(f"{source}: no rows, or rows of another length than the header")
    roles = _roles(header)
    camera = roles.get("camera")
    names = sorted({row[camera] for row in rows}, key=natural) if camera is not None else [""]
    return [
        _view(
            source,
            name or source.name,
            header,
            rows if camera is None else [row for row in rows if row[camera] == name],
            roles,
        )
        for name in names
    ]


def _view(source: Source, name: str, header: Row, rows: list[Row], roles: dict[str, int]) -> View:
    """Pivot rows to one for each frame."""
    columns = _columns(header)
    frames = _frames(rows, roles)
    order = sorted(set(frames), key=natural)
    place = {frame: index for index, frame in enumerate(order)}
    labels: dict[Label, int] = {}
    cells: list[tuple[int, int]] = []
    values = numbers_of_cells([[row[column] for column in columns] for row in rows], str(source))
    for row, frame in zip(rows, frames, strict=True):
        person = row[roles["person"]] if "person" in roles else ""
        for keypoint, axis in columns.values():
            point = row[roles["keypoint"]] if "keypoint" in roles else keypoint
            label = (person, point, axis)
            cells.append((place[frame], labels.setdefault(label, len(labels))))
    table = np.full((len(order), len(labels)), np.nan)
    where = np.array(cells).reshape(-1, 2)
    table[where[:, 0], where[:, 1]] = values.reshape(-1)
    numbers = row_numbers([int(frame) if frame.isdigit() else frame for frame in order])
    view = view_of_columns(name, list(labels), table, numbers, str(source))
    if "time" not in roles:
        return view
    told = dict(zip(frames, [row[roles["time"]] for row in rows], strict=True))
    times = numbers_of_cells([[told[frame]] for frame in order], str(source))[:, 0]
    return replace(view, times=times if np.isfinite(times).all() else None)


def _frames(rows: list[Row], roles: dict[str, int]) -> list[str]:
    """Return what names each row's frame: its number, its time, or its place."""
    for role in ("frame", "time"):
        if role in roles:
            named = [row[roles[role]] for row in rows]
            return [cell.removesuffix(".0") for cell in named] if role == "frame" else named
    return [str(number) for number in range(len(rows))]


def _delimiter(text: str) -> str:
    first = text.partition("\n")[0]
    return max(",;\t", key=first.count)


def _cells(line: str) -> Row:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=_delimiter(line)), [])]


def _roles(header: Sequence[str]) -> dict[str, int]:
    lower = [cell.lower() for cell in header]
    return {
        role: lower.index(name)
        for role, names in ROLES.items()
        for name in reversed(names)
        if name in lower
    }


def _columns(header: Sequence[str]) -> dict[int, tuple[str, str]]:
    """Return of each column with a coordinate its keypoint ("" in a tidy table) and its axis."""
    tidy = "keypoint" in _roles(header)
    found: dict[int, tuple[str, str]] = {}
    for index, cell in enumerate(header):
        if tidy:
            if cell.lower() in (*COORDINATES, "z"):
                found[index] = ("", cell.lower())
        elif index not in _roles(header).values():
            if match := _WIDE.match(cell):
                found[index] = (match[1], match[2].lower())
            elif match := _TURNED.match(cell):
                found[index] = (match[2], match[1].lower())
    return {i: said for i, said in found.items() if said[0].lower() != "instance"}


def _wide(header: Sequence[str]) -> bool:
    columns = _columns(header).values()
    return any((name, "x") in columns and (name, "y") in columns for name, _ in columns)
