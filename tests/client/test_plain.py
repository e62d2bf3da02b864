"""Names of others do nothing to a terminal or a spreadsheet, and are read back as they were."""

import csv
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fewview import read, write
from fewview.commands.talking import echo, table
from fewview.plain import visible
from fewview.writers.labels import LABEL_FORMATS, write_labels

from tests.client.writers.conftest import animation  # noqa: F401 (a fixture)
from tests.client.writers.test_labels import labels
from worker.logs import _Text

FORMULAS = ("=cmd|'/C calc'!A0", "@SUM(A1)", "+nose", "-2+3", "'=quoted", "\tindented", "=1,2")
ROOT = Path(__file__).parents[2]
ESCAPES = ("\x1b[2J\x1b]0;title\x07", "\x9b31m", "a\u202eb", "a\rb", "\x08\x08", "\x7f", "\ud800")


def cells(file: Path) -> list[str]:
    with file.open(newline="", encoding="utf-8") as lines:
        return [cell for row in csv.reader(lines) for cell in row]


def acts(cell: str) -> bool:
    try:
        float(cell or "0")
    except ValueError:
        return cell[0] in "=+-@\t\r"
    return False


@pytest.mark.parametrize("format", ["csv", "csv-tidy"])
def test_no_table_of_an_animation_has_formulas(
    format: str,
    tmp_path: Path,
    animation: Any,  # noqa: F811
) -> None:
    hostile = replace(animation, keypoint_names=FORMULAS[:5])
    file = write(tmp_path / "a.csv", hostile, format=format)
    written = cells(file)
    assert not [cell for cell in written if acts(cell)]
    assert any(cell.startswith("-") for cell in written)  # numbers are what they were
    assert any("'=cmd" in cell for cell in written)


@pytest.mark.parametrize("format", [known.name for known in LABEL_FORMATS])
def test_no_table_of_labels_has_formulas_and_our_reader_reads_the_names(
    format: str, tmp_path: Path
) -> None:
    made = labels()
    views = tuple(
        replace(
            view,
            keypoints=_more(view.keypoints),
            weights=_more(view.weights),
            detected=_more(view.detected),
        )
        for view in made.views
    )
    hostile = replace(made, views=views, keypoint_names=FORMULAS)
    files = write_labels(tmp_path, hostile, format)
    tables = [file for file in files if file.suffix == ".csv"]
    assert not [cell for file in tables for cell in cells(file) if acts(cell)]
    if tables:
        assert read(tables).keypoint_names == FORMULAS


def _more(values: Any) -> Any:
    return np.concatenate([values, values], 1)[:, : len(FORMULAS)]


def test_there_is_one_writer_of_tables() -> None:
    folders = ("client/fewview", "service", "worker", "store")
    files = (file for folder in folders for file in (ROOT / folder).rglob("*.py"))
    made = [file.name for file in files if "csv.writer" in file.read_text()]
    assert made == ["plain.py"]


def test_all_that_commands_print_goes_through_one_door(capsys: Any) -> None:
    for name in ESCAPES:
        echo(table([(name, "size"), ("walk\nforged", "2")]))
        echo(f"fewview: {name}", err=True)
        record = logging.makeLogRecord({"msg": f"Dataset {name}", "levelname": "INFO"})
        record.context = ""
        shown = capsys.readouterr()
        for text in (shown.out, shown.err, _Text("%(message)s%(context)s").format(record)):
            assert all(letter.isprintable() or letter == "\n" for letter in text)
    assert visible("\x1b[31mred") == "\\x1b[31mred"
    assert visible("näse, 鼻, 👩\u200d🔬\tx\n") == "näse, 鼻, 👩\u200d🔬\tx\n"
    for file in (ROOT / "client/fewview/commands").glob("*.py"):
        direct = [word for word in ("typer.echo", "print(", "click.") if word in file.read_text()]
        assert not direct or file.name == "talking.py", file
