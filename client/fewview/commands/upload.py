"""``fewview upload``: files of keypoints become a dataset."""

from typing import Annotated

import typer

from fewview.commands.reading import Files, Options, reading_files
from fewview.commands.talking import (
    AsJson,
    Metadata,
    Tags,
    Url,
    capture_in,
    echo,
    fields_in,
    findings_in,
    say,
    talking,
)


@reading_files
def upload(
    options: Options,
    files: Files,
    *,
    name: Annotated[str | None, typer.Option(help="Of the dataset; else that of a file.")] = None,
    tag: Tags = None,
    metadata: Metadata = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Store the keypoints of all cameras as a dataset; prints its id."""
    with talking(url) as client:
        capture = capture_in(files, options())
        dataset = client.datasets.create(
            capture,
            name=name or files[0].stem[:200],
            tags=tag or (),
            metadata=fields_in(metadata, "--metadata"),
        )
        for line in findings_in(dataset.raw):
            echo(line, err=True)
        say(dataset.raw, dataset.id, as_json=as_json)
