"""Text with separators, read column by column and without holding all of it in memory."""

import csv
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from fewview.errors import FormatError
from fewview.readers.sources import Source
from fewview.readers.views import Int64

SEPARATORS = ",;\t"
CHUNK = 4096  # rows
NOTHING = ("", "na", "n/a", "none", "null", "<na>")


@dataclass(frozen=True)
class Words:
    """A column of text: its words in the order in which they appear, and which one a row has."""

    words: tuple[str, ...]
    codes: Int64

    def rows(self) -> list[str]:
        """Return the word of each row."""
        return [self.words[code] for code in self.codes]


def separator(header: str) -> str:
    """Return what stands between the cells of a header."""
    return max(SEPARATORS, key=header.count)


def cells(line: str, between: str) -> list[str]:
    """Return the cells of a line."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=between), [])]


def read_columns(
    source: Source,
    start: int,
    between: str,
    count: int,
    *,
    texts: Sequence[int],
    numbers: Sequence[int],
) -> tuple[list[Words], NDArray[np.float64]]:
    """Read the columns of a table that are wanted.

    Parameters
    ----------
    start
        Lines above the first row, without empty ones.
    between
        What stands between cells.
    count
        Cells of each row.
    texts, numbers
        Which columns hold text, and which C hold numbers.

    Returns
    -------
    tuple
        The columns of text, and the numbers (N, C). Cells that are empty, or say so, are NaN;
        numbers may have a comma for a point where no comma stands between cells.

    Raises
    ------
    FormatError
        If a row has another count of cells, or a cell holds no number.
    """
    known: list[dict[str, int]] = [{} for _ in texts]
    codes = [array("q") for _ in texts]
    parts = [np.empty((0, len(numbers)))]
    lines = islice(source.text_lines(), start, None)
    rows_read = csv.reader(lines, delimiter=between)
    try:
        while rows := list(islice(rows_read, CHUNK)):
            if any(len(row) != count for row in rows):
                raise FormatError(
                    f"{source}: has rows of another length than the header, which has {count} cells"
                )
            for column, words, code in zip(texts, known, codes, strict=True):
                code.extend(words.setdefault(row[column].strip(), len(words)) for row in rows)
            parts.append(_numbers([[row[i] for i in numbers] for row in rows]))
    except (ValueError, csv.Error) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{source}: not a table of numbers ({error})") from error
    return (
        [Words(tuple(w), np.array(c, np.int64)) for w, c in zip(known, codes, strict=True)],
        np.concatenate(parts),
    )


def _numbers(rows: list[list[str]]) -> NDArray[np.float64]:
    try:
        return np.array(rows, np.float64)  # much faster than cell by cell
    except ValueError:
        return np.array([[_number(cell) for cell in row] for row in rows], np.float64)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan if cell.strip().lower() in NOTHING else float(cell.replace(",", "."))
