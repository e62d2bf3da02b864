"""What all commands that talk to the service have in common: options, errors, output."""

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fewview.errors import FewviewError, FormatError, InvalidRequest, NotFound
from fewview.plain import visible

if TYPE_CHECKING:
    from fewview.capture import Capture
    from fewview.client import Client
    from fewview.reading_options import ReadingOptions

PATIENCE = 5.0  # seconds for a service that is away, which at a keyboard is long
FAILED, WRONGLY_ASKED, INTERRUPTED = 1, 2, 130  # exit statuses
ASKED_WRONGLY = (InvalidRequest, NotFound, FormatError, ValueError, FileNotFoundError)

Url = Annotated[
    str | None,
    typer.Option(
        "--url", envvar="FEWVIEW_URL", help="Where the service is; usually http://127.0.0.1:8000."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Tags = Annotated[list[str] | None, typer.Option(help="A word to find it by; may repeat.")]
Metadata = Annotated[
    list[str] | None, typer.Option(help="`key=value` or JSON to find it by; may repeat.")
]


def finite(number: float | None) -> float | None:
    """Return the number of an option; refuse what is none, which a range lets through."""
    if number is not None and not math.isfinite(number):
        raise typer.BadParameter(f"expected a finite number, got {number}")
    return number


def echo(text: str, *, err: bool = False) -> None:
    """Print a line: all that commands print goes through here.

    Names and messages may be of others: what would act on the terminal is spelled out.
    """
    typer.echo(visible(text), err=err)


@contextmanager
def talking(url: str | None) -> Iterator["Client"]:
    """Give a client; an error ends the command with a line on stderr and its exit status."""
    from fewview.client import Client  # noqa: PLC0415 (commands load what they need)

    try:
        with Client(url, patience=PATIENCE) as client:
            yield client
    except (FewviewError, ValueError, OSError) as error:
        status = WRONGLY_ASKED if isinstance(error, ASKED_WRONGLY) else FAILED
        echo(f"fewview: {in_short(error)}", err=True)
        raise typer.Exit(status) from None
    except KeyboardInterrupt:
        echo("fewview: interrupted; what the service was asked for goes on", err=True)
        raise typer.Exit(INTERRUPTED) from None


def in_short(error: Exception) -> str:
    """Return what went wrong in one line; of a file, which one."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, FormatError):
        option = f"--{error.option.replace('_', '-')}" if error.option else ""
        given = f"{option} {shlex.quote(error.remedy)}"
        return " ".join(error.worded(option, given).split())
    return " ".join(str(error).split())


def capture_in(files: Sequence[Path], reading: "ReadingOptions") -> "Capture":
    """Read files of keypoints, and print on stderr what was changed.

    Raises
    ------
    FormatError
        They cannot be read.
    """
    from fewview.readers import read_with  # noqa: PLC0415

    capture = read_with(files, reading)
    for note in capture.notes:
        echo(note, err=True)
    return capture


def fields_in(texts: Sequence[str] | None, option: str) -> dict[str, Any]:
    """Return the fields in JSON objects and in ``key=value``, later ones over earlier.

    A value that is JSON is read as such, else it is a word, as in ``cameras=static``.

    Raises
    ------
    ValueError
        A text is neither; it names the option that had it.
    """
    fields: dict[str, Any] = {}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not text.lstrip().startswith("{") and key and equals:
            fields[key.strip()] = _value(value)
            continue
        try:
            fields |= json.loads(text)
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{option}: expected a JSON object or key=value, got {text!r}"
            ) from error
    return fields


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def say(result: Mapping[str, Any], words: str, *, as_json: bool) -> None:
    """Print a result: for people, or all of it for machines."""
    echo(json.dumps(result) if as_json else words)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of text as lines with columns; a name with line breaks has none in it."""
    rows = [[visible(" ".join(text.splitlines())) for text in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def findings_in(
    result: Mapping[str, Any], view_names: Sequence[str] | None = None
) -> Iterator[str]:
    """Give a line for each thing that was noticed, after one on what may be relied on."""
    from fewview.mended import mended_in_words, put_right  # noqa: PLC0415 (commands load what they need)

    verdict = result.get("verdict")
    if verdict:
        yield f"{verdict['level']}: {verdict['reliable']}"
        if verdict.get("expected"):
            yield verdict["expected"]
    for finding in result.get("findings", ()):
        mended = mended_in_words(finding, view_names)
        if mended is not None:
            yield mended
        if put_right(finding):  # nothing is left to do
            continue
        yield f"{finding['severity']}: {finding['code']}. {finding['effect']} {finding['remedy']}"
