"""``fewview datasets correct``, ``corrections``, ``undo``: keypoints that a human put right."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fewview.commands.talking import AsJson, Url, say, table, talking
from fewview.corrections import COLUMNS, named, read_corrections, write_corrections

if TYPE_CHECKING:
    from fewview.api.forms import Dataset

SHOWN = 50  # of many
Identifier = Annotated[str, typer.Argument(metavar="ID")]
Name = Annotated[str | None, typer.Option(help="Those of this one, by name or counted from 0.")]


def correct(
    identifier: Identifier,
    *,
    file: Annotated[
        Path,
        typer.Option(
            help="A CSV file with the columns frame, view, keypoint, x, y. Views and keypoints by "
            "name or counted from 0; without x and y a keypoint is removed."
        ),
    ],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the file, and change nothing.")
    ] = False,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Correct keypoints of a dataset; fit it again to see what comes of it.

    What was detected is kept, and `undo` brings it back.
    """
    with talking(url) as client:
        corrections = read_corrections(file)
        state = client.datasets.correct(identifier, corrections, dry_run=dry_run)
        would = "would have" if dry_run else "has"
        words = f"{identifier} {would} {_count(state.count)}"
        say(asdict(state), words, as_json=as_json)


def list_corrections(
    identifier: Identifier,
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The CSV file to write, as `correct` reads it."),
    ] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """List the keypoints of a dataset that were corrected or removed, or write them to a file."""
    with talking(url) as client:
        found = client.datasets.corrections(identifier)
        dataset = client.datasets.get(identifier)
        views, keypoints = _names(dataset)
        result: dict[str, Any] = asdict(found)
        lines = [_count(found.count)]
        if output is not None:
            names = {"view_names": views, "keypoint_names": keypoints}
            result["file"] = str(write_corrections(output, found.items, **names))
            lines.append(f"wrote {result['file']}")
        elif found.items:
            rows = [
                [
                    str(each.frame),
                    str(named(each.view, views)),
                    str(named(each.keypoint, keypoints)),
                    *(f"{pixels:.1f}" for pixels in each.position or ()),
                    *(() if each.position else ("removed", "")),
                ]
                for each in found.items[:SHOWN]
            ]
            lines.insert(0, table([COLUMNS, *rows]))
            if found.count > SHOWN:
                lines[-1] += f", of which {SHOWN} are shown; `--output` writes all"
        say(result, "\n".join(lines), as_json=as_json)


def undo(
    identifier: Identifier,
    *,
    frame: Annotated[int | None, typer.Option(min=0, help="Those of this frame.")] = None,
    view: Name = None,
    keypoint: Name = None,
    every: Annotated[bool, typer.Option("--all", help="All corrections of the dataset.")] = False,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Undo corrections of a dataset: those that all options allow; keypoints are as detected."""
    with talking(url) as client:
        if not every and (frame, view, keypoint) == (None, None, None):
            raise ValueError("name a --frame, --view or --keypoint, or give --all")
        found = client.datasets.corrections(identifier)
        views, keypoints = _names(client.datasets.get(identifier))
        undone = [
            each
            for each in found.items
            if frame in (None, each.frame)
            and view in (None, str(each.view), named(each.view, views))
            and keypoint in (None, str(each.keypoint), named(each.keypoint, keypoints))
        ]
        state = client.datasets.correct(identifier, undo=undone)
        words = f"undid {_count(len(undone))}; {identifier} has {_count(state.count)}"
        say(asdict(state) | {"undone": len(undone)}, words, as_json=as_json)


def _names(dataset: "Dataset") -> tuple[list[str] | None, list[str] | None]:
    skeleton = dataset.raw.get("skeleton") or {}
    return dataset.raw.get("view_names"), skeleton.get("keypoint_names")


def _count(number: int) -> str:
    return f"{number or 'no'} correction{'' if number == 1 else 's'}"
