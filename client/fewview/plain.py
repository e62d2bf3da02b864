"""Texts of others as they may be printed: nothing in them acts on a terminal or a spreadsheet."""

import csv
import re
from collections.abc import Iterable
from typing import IO, Any

# Control characters, which move cursors and colour lines, and what turns the direction of text.
# New lines and tabs stay, as texts for people have them.
ACTING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)
FORMULA = re.compile(r"\A'*[=+\-@\t]")  # with which spreadsheets begin a formula
BREAKS = re.compile(r"[\r\n\v\f\x1c-\x1e\x85\u2028\u2029]+")  # of which our own reader makes lines


def visible(text: str) -> str:
    """Return a text in which escapes, control characters and turns of direction are spelled out."""
    return ACTING.sub(_spelled, text)


def _spelled(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


class TableWriter:
    """Writes every CSV of ours, as in RFC 4180.

    Names that a spreadsheet would take for formulas get an apostrophe before them;
    :func:`unguarded` takes it off again. Numbers are untouched; breaks of lines are blanks.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._rows = csv.writer(stream)

    def writerow(self, row: Iterable[Any]) -> None:
        """Write a row."""
        self._rows.writerow([_guarded(cell) for cell in row])

    def writerows(self, rows: Iterable[Iterable[Any]]) -> None:
        """Write rows."""
        for row in rows:
            self.writerow(row)


def _guarded(cell: Any) -> Any:
    if not isinstance(cell, str) or not cell or cell[0].isdigit():
        return cell
    cell = BREAKS.sub(" ", cell)
    return f"'{cell}" if FORMULA.match(cell) and not is_number(cell) else cell


def is_number(text: str) -> bool:
    """Whether a text is a number as Python reads it."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def unguarded(cell: str) -> str:
    """Return the name that a cell of our tables is for."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
