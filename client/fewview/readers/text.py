"""Text in any encoding: finding the encoding of its bytes, and its lines."""

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

from fewview.errors import FormatError

HEAD = 2**16  # bytes that are looked at first
CHUNK = 2**20
LONGEST_LINE = 2**24  # characters: 65,536 columns of numbers take a sixteenth of it
MARKS = (  # bytes at the beginning that name the encoding; the longer first
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
WESTERN = "cp1252"  # of Windows in western Europe, where no other encoding fits
BINARY = re.compile(rb"[\x00-\x08\x0e-\x19\x1b-\x1f]")
SEPARATOR_LINE = re.compile(r'"?sep=(.)"?', re.IGNORECASE)  # with which spreadsheets begin


def encoding_of(path: Path, head: bytes) -> str | None:
    """Return the encoding of a file that begins with these bytes; None if it is no text."""
    for mark, name in MARKS:
        if head.startswith(mark):
            return name
    for name, zeros, letters in (("utf-16-le", 1, 0), ("utf-16-be", 0, 1)):
        pairs = len(head) // 2
        if pairs and not any(head[zeros : 2 * pairs : 2]) and all(head[letters : 2 * pairs : 2]):
            return name
    if BINARY.search(head):
        return None
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return WESTERN
    return "utf-8"


def lines_of(path: Path, encoding: str) -> Iterator[str]:
    """Yield the lines of a text that are not empty, without their ends, nor a line ``sep=;``.

    Raises
    ------
    FormatError
        If it cannot be read, or a line is too long.
    """
    errors = "replace" if encoding == WESTERN else "strict"
    first = True
    try:
        with path.open(encoding=encoding, errors=errors, buffering=CHUNK) as file:
            while line := file.readline(LONGEST_LINE):
                if len(line) == LONGEST_LINE:
                    raise FormatError(
                        f"a line has more than {LONGEST_LINE:,} characters, so this is no "
                        "table of keypoints",
                        place=path,
                    )
                if line.strip():
                    line = line.rstrip("\n")
                    if not (first and given_separator(line)):
                        yield line
                    first = False
    except (OSError, UnicodeError) as error:
        raise FormatError(f"cannot be read as text ({error})", place=path) from error


def given_separator(line: str) -> str | None:
    """Return the separator that a line such as ``sep=;`` names; None if it is another line."""
    found = SEPARATOR_LINE.match(line)
    # What follows are separators alone: spreadsheets fill the line up.
    return found[1] if found and not line[found.end() :].strip(f'{found[1]}"') else None
