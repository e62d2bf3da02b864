"""``fewview fit``: a dataset becomes a model."""

from pathlib import Path
from typing import Annotated, Any

import typer

from fewview.commands.progress import FitProgressBar
from fewview.commands.talking import (
    AsJson,
    Metadata,
    Tags,
    Url,
    echo,
    fields_in,
    findings_in,
    say,
    talking,
)

CalibrationFile = Annotated[
    Path | None,
    typer.Option(
        help="Of Anipose, OpenCV or COLMAP; by the views' names, else in order. Of `fewview fit` "
        "also `dataset`: what came with it."
    ),
]
KnownLength = Annotated[
    str | None,
    typer.Option(help="`FIRST,SECOND,METRES`: two keypoints and how far they are apart."),
]

LensOption = Annotated[
    str | None,
    typer.Option(
        "--lens",
        help="`26mm`, `fov:78`, `1460px`, or each view's: `cam1=fov:78,cam2=26mm+-10%`.",
    ),
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
    known_length: KnownLength = None,
    lens: LensOption = None,
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
    from fewview.lenses import lenses_in  # noqa: PLC0415 (the same)

    with talking(url) as client:
        fields = config_in(config or [], known_length)
        if lens is not None:
            of = client.datasets.get(dataset)
            fields["lenses"] = lenses_in(lens, of.view_names or [f"{k}" for k in range(of.views)])
        if calibration == Path("dataset"):
            fields["calibration"] = "dataset"
        elif calibration is not None:
            stored = client.datasets.get(dataset)
            known, note = read_for_views(calibration, stored.view_names, stored.views)
            fields["calibration"] = known
            echo(note, err=True)
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
            echo(line, err=True)
        say(done.raw, str(done.model_id), as_json=as_json)


def config_in(texts: list[str], known_length: str | None) -> dict[str, Any]:
    """Return the fit's configuration, with the known length in it.

    Raises
    ------
    ValueError
        If one of them cannot be read; the message names it and the expected form.
    """
    config = fields_in(texts, "--config")
    if known_length is not None:
        parts = known_length.rsplit(",", 2)
        try:
            first, second, metres = parts
            length = float(metres)
            if not length > 0:
                raise ValueError
        except ValueError as error:
            raise ValueError(
                f"--known-length {known_length}: expected FIRST,SECOND,METRES, such as "
                "left_hip,left_knee,0.41"
            ) from error
        pair = [int(part) if part.isdecimal() else part for part in (first, second)]
        config["known_length"] = {"keypoints": pair, "length": length}
    return config
