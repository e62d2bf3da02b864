"""``fewview fit``: a dataset becomes a model."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    in_short,
    say,
    talking,
)
from fewview.errors import ApiError, ConnectionFailed

if TYPE_CHECKING:
    from fewview.api.schedule_forms import FitSchedule

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
KnownDistance = Annotated[
    str | None,
    typer.Option(help="`VIEW,VIEW,METRES`: two static cameras and how far they are apart."),
]
LensOption = Annotated[
    str | None,
    typer.Option(
        "--lens",
        help="`26mm`, `fov:78`, `1460px`, or each view's: `cam1=fov:78,cam2=26mm+-10%`.",
    ),
]
MendOption = Annotated[
    Literal["off", "auto"] | None,
    typer.Option(
        help="`auto`: undo what is wrong with single views' pixels (crops, padding, mirrors ...)."
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
    known_distance: KnownDistance = None,
    lens: LensOption = None,
    calibration: CalibrationFile = None,
    mend: MendOption = None,
    name: Annotated[str | None, typer.Option(help="Of the fit and its model.")] = None,
    from_model: Annotated[str | None, typer.Option(help="A model to start from: mdl_...")] = None,
    priority: Annotated[
        Literal["high", "normal", "low"] | None,
        typer.Option(help="Among the fits of your project that wait."),
    ] = None,
    tag: Tags = None,
    metadata: Metadata = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Queue a fit of a dataset; prints its id, or with --follow that of its model."""
    from fewview.calibration import read_for_views  # noqa: PLC0415 (commands load what they need)

    with talking(url) as client:
        fields = config_in(config or [], known_length, mend)
        if lens is not None or known_distance is not None:
            of = client.datasets.get(dataset)
            fields |= of_views(lens, known_distance, of.view_names, of.views)
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
            priority=priority,
            tags=tag or (),
            metadata=fields_in(metadata, "--metadata"),
            **fields,
        )
        if not follow:
            say(made.raw, made.id, as_json=as_json)
        if not as_json:
            try:
                echo(_in_words(client.fits.schedule(made)), err=True)
            except (ApiError, ConnectionFailed) as error:  # it is queued when the queue is back
                echo(f"it is not known when it starts: {in_short(error)}", err=True)
        if not follow:
            return
        with FitProgressBar(quiet=as_json) as bar:
            done = client.fits.wait(made, on_progress=bar.show)
        names = client.datasets.get(dataset).view_names if done.findings else None
        for line in findings_in(done.raw, names):
            echo(line, err=True)
        say(done.raw, str(done.model_id), as_json=as_json)


def _in_words(schedule: "FitSchedule") -> str:
    """Return in words when a fit is expected to start and to end, in local time."""
    ahead = f"{schedule.ahead} fit{'s' * (schedule.ahead != 1)} ahead"
    if schedule.status == "queued" and not schedule.workers:
        return f"{ahead}; no worker takes from its queue: fewview worker starts one"
    start, end = (
        when and when.astimezone().strftime("%H:%M:%S")
        for when in (schedule.expected_start, schedule.expected_end)
    )
    if start is None or end is None:
        return f"{ahead}; how long a fit takes is known after the first"
    return f"{ahead}; expected to start at {start} and to end at {end}"


def config_in(
    texts: list[str], known_length: str | None, mend: str | None = None
) -> dict[str, Any]:
    """Return the fit's configuration, with the known length and what is to be undone in it.

    Raises
    ------
    ValueError
        If one of them cannot be read; the message names it and the expected form.
    """
    config = fields_in(texts, "--config") | ({} if mend is None else {"mend": mend})
    if known_length is not None:
        form = "FIRST,SECOND,METRES, such as left_hip,left_knee,0.41"
        *ends, length = _measured(known_length, "--known-length", form)
        pair = [int(end) if end.isdecimal() else end for end in ends]
        config["known_length"] = {"keypoints": pair, "length": length}
    return config


def of_views(
    lens: str | None, known_distance: str | None, names: Sequence[str] | None, views: int
) -> dict[str, Any]:
    """Return the fields of the configuration that `--lens` and `--known-distance` give.

    Raises
    ------
    ValueError
        If one of them cannot be read, or there is no such view; the message names it.
    """
    from fewview.lenses import lenses_in, view_in  # noqa: PLC0415 (commands load what they need)

    names = names or [f"{view}" for view in range(views)]
    fields: dict[str, Any] = {} if lens is None else {"lenses": lenses_in(lens, names)}
    if known_distance is not None:
        option = "--known-distance"
        *ends, length = _measured(known_distance, option, "VIEW,VIEW,METRES, such as cam1,cam2,2.5")
        pair = [view_in(end.strip(), names, option) for end in ends]
        if pair[0] == pair[1]:
            raise ValueError(f"{option} {known_distance}: expected two different views")
        fields["known_distance"] = {"views": pair, "length": length}
    return fields


def _measured(text: str, option: str, form: str) -> tuple[str, str, float]:
    """Return two ends and how far they are apart; raise ValueError if the text is not such."""
    try:
        first, second, metres = text.rsplit(",", 2)
        length = float(metres)
        if not 0 < length < math.inf:
            raise ValueError
    except ValueError as error:
        raise ValueError(f"{option} {text}: expected {form}") from error
    return first, second, length
