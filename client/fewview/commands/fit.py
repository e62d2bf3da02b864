"""``fewview fit``: a dataset becomes a model."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from fewview.commands.progress import FitProgressBar
from fewview.commands.talking import AsJson, Url, findings_in, say, talking

CalibrationFile = Annotated[
    Path | None,
    typer.Option(help="Of Anipose, OpenCV or COLMAP; its cameras in the order of the views."),
]


def fit(
    dataset: Annotated[str, typer.Argument(help="Its id: ds_...")],
    *,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Wait; says the model.")] = False,
    config: Annotated[
        list[str] | None,
        typer.Option(
            "--config", "-c", help="A JSON object, or `key=value` as in `-c steps=500`; may repeat."
        ),
    ] = None,
    calibration: CalibrationFile = None,
    name: Annotated[str | None, typer.Option(help="Of the fit and its model.")] = None,
    from_model: Annotated[str | None, typer.Option(help="A model to start from: mdl_...")] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Queue a fit of a dataset; says its id, or with --follow that of its model."""
    with talking(url) as client:
        fields = read_config(config or [])
        if calibration is not None:
            fields["calibration"] = calibration
        made = client.fits.create(dataset, name=name, from_model=from_model, **fields)
        if not follow:
            say(made.raw, made.id, as_json=as_json)
            return
        with FitProgressBar(quiet=as_json) as bar:
            done = client.fits.wait(made, on_progress=bar.show)
        for line in findings_in(done.raw):
            typer.echo(line, err=True)
        say(done.raw, str(done.model_id), as_json=as_json)


def read_config(texts: list[str]) -> dict[str, Any]:
    """Return the fields in JSON objects and in ``key=value``, later ones over earlier.

    A value that is JSON is read as such, else it is a word, as in ``cameras=static``.

    Raises
    ------
    ValueError
        A text is neither.
    """
    fields: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not text.lstrip().startswith("{") and key and equals:
            fields[key.strip()] = _value(value)
            continue
        try:
            fields |= json.loads(text)
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"--config: expected a JSON object or key=value, got {text!r}"
            ) from error
    return fields


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
