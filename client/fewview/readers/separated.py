"""Text with separators: its dialect and header, found once; read without holding all of it."""

import csv
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np

from fewview.capture import Float32
from fewview.errors import FormatError
from fewview.plain import unguarded
from fewview.readers.large_arrays import gathered
from fewview.readers.sources import Source
from fewview.readers.views import Int64

SEPARATORS = ",;\t|"
NOTES = ("#", "%", "//")
FEWEST_CELLS = 3  # of a line of keypoints
UNITS = {"px", "pixel", "pixels", "s", "ms", "frames", "frame", "-", "1", "%"}
CHUNK = 4096  # rows
_TITLE = re.compile(r"[A-Za-z_ ]+")
COORDINATE_ROW = re.compile(
    r"coords|x|y|z|likelihood|confidence|conf|score|prob(ability)?|visibility"
)
NOTHING = {
    *("", "na", "n/a", "#n/a", "#na", "nan", "-nan", "#nan", "none", "null", "<na>", "nil", "."),
    *("?", "-", "--", "#value!", "#div/0!", "#num!", "-1.#ind", "1.#qnan", "-nan(ind)", "missing"),
}


@dataclass(frozen=True)
class Table:
    """A text with separators.

    Attributes
    ----------
    separator
        What stands between cells.
    header
        The rows above the numbers, of `width` cells each.
    start
        How many lines that are not empty are above the first row of numbers.
    """

    source: Source
    separator: str
    header: tuple[tuple[str, ...], ...]
    start: int

    @property
    def width(self) -> int:
        """Cells of each row."""
        return len(self.header[0])


@dataclass(frozen=True)
class Words:
    """A column of text: its words in the order in which they appear, and which one a row has."""

    words: tuple[str, ...]
    codes: Int64

    def rows(self) -> list[str]:
        """Return the word of each row."""
        return [self.words[code] for code in self.codes]


def table_of(source: Source) -> Table | None:
    """Return the table that a text is; None if it is none, or has no header.

    A header is the rows down to one of coordinates (x, y, ...), or else the first row. A row below
    it that only names the columns of the index belongs to it.
    """
    if source.frames:
        return None
    lines = source.lines
    separator = _separator(lines)
    notes = next((i for i, line in enumerate(lines) if not _is_note(line, separator)), len(lines))
    rows = [cells(line, separator) for line in lines[notes:]]
    if not rows or all(_is_number(cell) for cell in rows[0]):
        return None
    end = 1 + max((i for i, row in enumerate(rows[:6]) if _names_coordinates(row)), default=0)
    if end < len(rows) and (_names_units(rows[end]) or (end > 1 and _names_index(rows[end]))):
        end += 1
    header, width = rows[:end], max(map(len, rows[:end]))
    if end < len(rows) and len(rows[end]) == width + 1 and rows[end][-1]:
        header = [["", *row] for row in header]  # R leaves out the name of the rows' names
        width += 1
    filled = tuple(tuple(row + [""] * (width - len(row))) for row in header)
    return Table(source, separator, filled, notes + end)


def cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    try:
        return [unguarded(cell.strip()) for cell in next(_reader([line], separator), [])]
    except csv.Error:
        return [line]


def _reader(lines: Iterable[str], separator: str) -> Iterator[list[str]]:
    """Yield the cells of lines; blanks that separate may be many."""
    return csv.reader(lines, delimiter=separator, skipinitialspace=separator == " ")


def _separator(lines: Sequence[str]) -> str:
    """Return what stands between cells: what parts all lines into as many, most of all."""
    kept = [line for line in lines if not line.startswith(NOTES)] or lines
    counts = {each: [len(cells(line, each)) for line in kept] for each in SEPARATORS}
    even = [each for each, found in counts.items() if len(set(found)) == 1 and found[0] > 1]
    found = max(even or SEPARATORS, key=lambda each: counts[each][0] if kept else 0)
    # Blanks are in names, too: they separate where nothing else does.
    by_blanks = {len(cells(line, " ")) for line in kept}
    blanks = kept and counts[found][0] < FEWEST_CELLS and len(kept) > 1 and len(by_blanks) == 1
    return " " if blanks else found


def _is_note(line: str, separator: str) -> bool:
    """Whether this is a remark above the table."""
    return line.startswith(NOTES) and len(cells(line, separator)) < FEWEST_CELLS


def _names_units(row: Sequence[str]) -> bool:
    cells = {cell.lower().strip("()[]") for cell in row if cell}
    return bool(cells & {"px", "pixel", "pixels"}) and cells <= UNITS


def _names_coordinates(row: Sequence[str]) -> bool:
    cells = [cell.lower() for cell in row if cell]
    named = [cell for cell in cells if COORDINATE_ROW.fullmatch(cell)]
    return len(named) * 2 > len(cells) and named.count("x") == named.count("y") > 0


def _names_index(row: Sequence[str]) -> bool:
    """Whether a row has a word in its first cell, and nothing in the others."""
    return bool(row[0]) and not any(row[1:]) and _TITLE.fullmatch(row[0]) is not None


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True


def read_columns(
    table: Table, *, texts: Sequence[int], numbers: Sequence[int], ragged: bool = False
) -> tuple[list[Words], Float32]:
    """Read the columns of a table that are wanted.

    Parameters
    ----------
    texts, numbers
        Which columns hold text, and which C hold numbers.
    ragged
        Whether a row may lack cells at its end: they are empty.

    Returns
    -------
    tuple
        The columns of text, and the numbers (N, C). Cells that are empty or marked as such are NaN;
        numbers may have a decimal comma. Empty rows are left out if columns of text identify the
        rows, and otherwise only at the end.

    Raises
    ------
    FormatError
        If a row has another count of cells, or a cell holds no number.
    """
    known: list[dict[str, int]] = [{} for _ in texts]
    codes = [array("q") for _ in texts]

    def parts() -> Iterator[Float32]:
        yield np.empty((0, len(numbers)), np.float32)
        for rows, part in _chunks(table, texts, numbers, ragged=ragged):
            for column, (words, code) in enumerate(zip(known, codes, strict=True)):
                code.extend(words.setdefault(row[column].strip(), len(words)) for row in rows)
            yield part

    try:
        values = gathered(parts())
    except (ValueError, csv.Error) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"not a table of numbers ({error})", place=table.source) from error
    return (
        [
            Words(tuple(map(unguarded, w)), np.array(c, np.int64))
            for w, c in zip(known, codes, strict=True)
        ],
        values,
    )


def _chunks(
    table: Table, texts: Sequence[int], numbers: Sequence[int], *, ragged: bool
) -> Iterator[tuple[list[list[str]], Float32]]:
    """Yield the cells of text and the numbers of many rows at a time."""
    lines: Iterator[str] = islice(table.source.text_lines(), table.start, None)
    while chunk := list(islice(lines, CHUNK)):
        plain = _plain_numbers(chunk, table, numbers)
        if plain is None:
            lines = chain(chunk, lines)
            break
        split = [line.split(table.separator, max(texts) + 1) for line in chunk] if texts else []
        yield [[row[i] for i in texts] for row in split], plain
    rows_read = _rows(lines, table, ragged=ragged, skip=bool(texts))
    while rows := list(islice(rows_read, CHUNK)):
        values = _numbers([[row[i] for i in numbers] for row in rows])
        yield [[row[i] for i in texts] for row in rows], values


def _plain_numbers(lines: list[str], table: Table, numbers: Sequence[int]) -> Float32 | None:
    """Read columns of numbers (N, C) an order of magnitude faster than cell by cell.

    None if the lines need more care: quoted cells, rows of another length or without an entry, and
    cells that are neither numbers nor marked as empty.
    """
    separator, gaps = table.separator, table.width - 1
    if separator == " " or not numbers:
        return None
    for line in lines:
        empty = line.startswith(separator) and not line.strip(separator)
        if empty or '"' in line or line.count(separator) != gaps:
            return None
    for spelled in (None, _filled, _respelled):
        try:
            read = np.loadtxt(
                lines if spelled is None else [spelled(line, separator) for line in lines],
                delimiter=separator,
                comments=None,
                usecols=numbers,
                ndmin=2,
                dtype=np.float32,
            )
        except ValueError:
            continue
        return np.asarray(read)
    return None


def _filled(line: str, separator: str) -> str:
    """Write NaN into empty cells."""
    empty = 2 * separator
    if empty in line:
        filled = f"{separator}nan{separator}"
        line = line.replace(empty, filled).replace(empty, filled)
    before = "nan" if line.startswith(separator) else ""
    return before + line + ("nan" if line.endswith(separator) else "")


def _respelled(line: str, separator: str) -> str:
    """Write NaN into cells that are empty or marked as such, and points for decimal commas."""
    return separator.join(map(_spelled, line.split(separator)))


def _rows(lines: Iterable[str], table: Table, *, ragged: bool, skip: bool) -> Iterator[list[str]]:
    """Yield the rows, each of the table's width; those without an entry as `read_columns` has it.

    Raises
    ------
    FormatError
        If a row has another count of cells.
    """
    width, blank = table.width, 0
    for cells_read in _reader(lines, table.separator):
        row = cells_read
        if not any(row):
            blank += not skip
            continue
        if len(row) > width and not any(map(str.strip, row[width:])):
            row = row[:width]
        elif len(row) < width and ragged:
            row = row + [""] * (width - len(row))
        if len(row) != width:
            raise FormatError(
                f"has rows of another length than the header, which has {width} cells",
                place=table.source,
            )
        yield from ([""] * width for _ in range(blank))
        blank = 0
        yield row


def _numbers(rows: list[list[str]]) -> Float32:
    try:
        return np.array(rows, np.float32)  # much faster than cell by cell
    except ValueError:
        return np.array([_row_of_numbers(row) for row in rows], np.float32)


def _row_of_numbers(row: list[str]) -> list[float]:
    try:
        return list(map(float, row))
    except ValueError:
        return list(map(_number, row))


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float(_spelled(cell))


def _spelled(cell: str) -> str:
    """Return a cell as `float` reads it: with a decimal point, and NaN where it is empty."""
    cell = cell.strip().lower()
    if cell in NOTHING:
        return "nan"
    if cell.rfind(".") < cell.rfind(","):  # 1.234,5
        cell = cell.replace(".", "")
    return cell.replace(",", ".")
