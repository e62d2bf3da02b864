"""TRC with 2D keypoints of one camera in pixels, z nowhere, as Sports2D writes it.

Three lines of header, then a name for each three columns, then the names of these: X1, Y1, Z1.
"""

from dataclasses import replace

import numpy as np

from fewview.errors import FormatError
from fewview.readers.columns import view_of_labels, without_depth
from fewview.readers.headers import Label
from fewview.readers.large_arrays import blocks, taken
from fewview.readers.separated import Table, cells, read_columns
from fewview.readers.sources import Source
from fewview.readers.views import View

HEADER = 5  # lines that are not empty
FRAME, TIME, FIRST = 0, 1, 2  # columns
METRIC = ("m", "cm", "mm")  # which Sports2D also writes for pixels
METRES = 20.0  # no one goes so far in front of one camera; pixels go further


def fits(source: Source) -> bool:
    """Whether this begins as TRC does, and its first points have no depth."""
    if not source.begins(b"PathFileType") or len(source.lines) < HEADER:
        return False
    rows = (cells(line, "\t")[FIRST:] for line in source.lines[HEADER:])
    return not any(_number(depth) for row in rows for depth in row[2::3])


def read(source: Source) -> list[View]:
    """Return the view of a file.

    Raises
    ------
    FormatError
        If its lines are not of one length, or the points have a z.
    """
    _, words, values, names, axes = (cells(line, "\t") for line in source.lines[:HEADER])
    header = dict(zip(words, values, strict=False))
    width = max(len(names), len(axes))
    names += [""] * (width - len(names))
    axes += [""] * (width - len(axes))
    labels: dict[int, Label] = {}
    name = ""
    for place in range(FIRST, width):
        name = names[place] or name
        if axes[place][:1].lower() in ("x", "y", "z"):
            labels[place] = Label("", "", name, axes[place][0].lower())
    table = Table(source, "\t", (tuple(axes),), HEADER)
    (frames, times), table_values = read_columns(
        table, texts=(FRAME, TIME), numbers=list(labels), ragged=True
    )
    flat = [place for place, label in enumerate(labels.values()) if label.axis != "z"]
    kept = [label for label in labels.values() if label.axis != "z"]
    numbers = _whole(frames.rows(), source)
    view = view_of_labels(
        source.name, kept, taken(table_values, flat, axis=1), numbers, str(source)
    )
    depths = [place for place, label in enumerate(labels.values()) if label.axis == "z"]
    view = without_depth(view, taken(table_values, depths, axis=1), str(source))
    far = (np.any(np.abs(view.keypoints[block]) > METRES) for block in blocks(view.keypoints))
    if header.get("Units") in METRIC and not any(far):
        raise FormatError(
            "a TRC file of metres in a plane; give the one of pixels (Sports2D's *_px_*)",
            place=source,
        )
    rate = _number(header.get("DataRate", ""))
    clock = np.array([_number(word) if word else np.nan for word in times.rows()], float)
    known = np.isfinite(clock).all() and bool(np.all(np.diff(clock) > 0))
    return [replace(view, fps=rate or None, times=clock if known else None)]


def _whole(words: list[str], source: Source) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    numbers = np.array([int(float(word)) if word else -1 for word in words], np.int64)
    if np.any(np.diff(numbers) <= 0):
        raise FormatError("its frame numbers do not rise", place=source)
    return numbers


def _number(word: str) -> float:
    """Return a number, 0 where there is none."""
    try:
        return float(word.replace(",", "."))
    except ValueError:
        return 0.0
