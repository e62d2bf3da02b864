"""Corrections of a dataset's keypoints, and files of them: CSV with a correction a line."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from fewview.errors import FormatError
from fewview.plain import TableWriter, unguarded

COLUMNS = ("frame", "view", "keypoint", "x", "y")
LONGEST = 5_000_000  # bytes of a file: a dataset has 5000 corrections at most


@dataclass(frozen=True)
class Place:
    """A keypoint of a view in a frame: indices from 0, or names of the dataset's."""

    frame: int
    view: int | str
    keypoint: int | str


@dataclass(frozen=True)
class Correction(Place):
    """Where a keypoint really is: x and y in pixels; None removes it."""

    position: tuple[float, float] | None


def read_corrections(file: str | PathLike[str]) -> list[Correction]:
    """Read a CSV file with the columns frame, view, keypoint, x and y.

    Views and keypoints are indices or names; without x and y a keypoint is removed.

    Raises
    ------
    FormatError
        It is no such file; the message names the line.
    """
    path = Path(file)
    if path.stat().st_size > LONGEST:
        raise FormatError("expected 5000 corrections at most", place=path.name)
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        rows = csv.DictReader(stream)
        missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
        if missing:
            raise FormatError(
                f"expected the columns {', '.join(COLUMNS)}; there is no {missing[0]}",
                place=path.name,
            )
        try:
            return [_correction(row) for row in rows]
        except (ValueError, csv.Error) as error:
            problem = f"line {rows.line_num}: {error}"
            raise FormatError(problem, place=path.name) from error


def write_corrections(
    file: str | PathLike[str],
    corrections: Iterable[Correction],
    *,
    view_names: Sequence[str] | None = None,
    keypoint_names: Sequence[str] | None = None,
) -> Path:
    """Write what :func:`read_corrections` reads, with names where they are given."""
    path = Path(file)
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = TableWriter(stream)
        rows.writerow(COLUMNS)
        for each in corrections:
            view, keypoint = named(each.view, view_names), named(each.keypoint, keypoint_names)
            rows.writerow([each.frame, view, keypoint, *(each.position or ("", ""))])
    return path


def named(index: int | str, names: Sequence[str] | None) -> int | str:
    """Return the name of an index; the index where there are no names."""
    return names[index] if names and isinstance(index, int) else index


def as_sent(
    place: Place, view_names: Sequence[str] | None, keypoint_names: Sequence[str] | None
) -> dict[str, Any]:
    """Return a correction, or the place of one, as the API takes it: by index.

    Raises
    ------
    FormatError
        A name is none of the dataset's.
    """
    sent: dict[str, Any] = {
        "frame": place.frame,
        "view": _index(place.view, view_names, "view"),
        "keypoint": _index(place.keypoint, keypoint_names, "keypoint"),
    }
    if isinstance(place, Correction):
        sent["position"] = place.position and list(place.position)
    return sent


def _index(name: int | str, names: Sequence[str] | None, kind: str) -> int:
    if isinstance(name, int):
        return name
    if name in (names or ()):
        return list(names or ()).index(name)
    if name.isdecimal() and name.isascii() and len(name) < 9:
        return int(name)
    known = f"one of {', '.join(names)}" if names else "an index, as it has no names"
    raise FormatError(f"no {kind} of the dataset is {name!r}: expected {known}")


def _correction(row: Mapping[str, str | None]) -> Correction:
    frame, view, keypoint, x, y = ((row[name] or "").strip() for name in COLUMNS)
    if not (frame.isdecimal() and frame.isascii() and len(frame) < 16):
        raise ValueError(f"expected a frame counted from 0, got {frame[:50]!r}")
    if not view or not keypoint:
        raise ValueError("expected a view and a keypoint, by name or counted from 0")
    if not x and not y:
        position = None
    elif x and y and math.isfinite(float(x)) and math.isfinite(float(y)):
        position = (float(x), float(y))
    else:
        raise ValueError("expected x and y in pixels, or neither, which removes the keypoint")
    return Correction(int(frame), unguarded(view), unguarded(keypoint), position)
