"""``fewview fit``: a dataset becomes a model."""

from pathlib import Path
from typing import Annotated

import typer

from fewview.commands.progress import FitProgressBar
from fewview.commands.talking import (
    AsJson,
    Metadata,
    Tags,
    Url,
    fields_in,
    findings_in,
    say,
    talking,
)

CalibrationFile = Annotated[
    Path | None,
    typer.Option(help="Of Anipose, OpenCV or COLMAP; by the views' names, else in order."),
]


def fit(
    dataset: Annotated[str, typer.Argument(help="Its id: ds_...")],
    *,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Wait, and print the model's id.")
    ] = False,
    config: Annotated[
        list[str] | None,
        typer.Option(
            "--config", "-c", help="A JSON object, or `key=value` as in `-c steps=500`; may repeat."
        ),
    ] = None,
    calibration: CalibrationFile = None,
    name: Annotated[str | None, typer.Option(help="Of the fit and its model.")] = None,
    from_model: Annotated[str | None, typer.Option(help="A model to start from: mdl_...")] = None,
    tag: Tags = None,
    metadata: Metadata = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Queue a fit of a dataset; prints its id, or with --follow that of its model."""
    from fewview.calibration import read_for_views  # noqa: PLC0415 (commands load what they need)

    with talking(url) as client:
        fields = fields_in(config, "--config")
        if calibration is not None:
            stored = client.datasets.get(dataset)
            known, note = read_for_views(calibration, stored.view_names, stored.views)
            fields["calibration"] = known
            typer.echo(note, err=True)
        made = client.fits.create(
            dataset,
            name=name,
            from_model=from_model,
            tags=tag or (),
            metadata=fields_in(metadata, "--metadata"),
            **fields,
        )
        if not follow:
            say(made.raw, made.id, as_json=as_json)
            return
        with FitProgressBar(quiet=as_json) as bar:
            done = client.fits.wait(made, on_progress=bar.show)
        for line in findings_in(done.raw):
            typer.echo(line, err=True)
        say(done.raw, str(done.model_id), as_json=as_json)
