"""``fewview upload``: files of keypoints become a dataset."""

from typing import Annotated

import typer

from fewview.commands.reading import Files
from fewview.commands.talking import AsJson, Url, capture_in, findings_in, say, talking


def upload(
    files: Files,
    *,
    name: Annotated[str | None, typer.Option(help="Of the dataset; else that of a file.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second, if they are even.")] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Store the keypoints of all cameras as a dataset; says its id."""
    with talking(url) as client:
        capture = capture_in(files)
        dataset = client.datasets.create(capture, name=name or files[0].stem[:200], fps=fps)
        for line in findings_in(dataset.raw):
            typer.echo(line, err=True)
        say(dataset.raw, dataset.id, as_json=as_json)
