"""``fewview cameras``: what a fit found out about its cameras."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fewview.commands.talking import AsJson, Url, findings_in, say, table, talking

if TYPE_CHECKING:
    from fewview.api.forms import Cameras, FoundCamera
    from fewview.capture import Float64

FORMS = {".toml": "anipose", ".yml": "opencv", ".yaml": "opencv", ".zip": "colmap"}
HEADING: tuple[str, ...] = (
    "view",
    "camera",
    "place",
    "focal",
    "centre",
    "distortion",
    "error",
)


def cameras(
    model: Annotated[str, typer.Argument(help="Its id, mdl_..., or an alias.")],
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Also write a calibration: .toml, .yml or .zip."),
    ] = None,
    form: Annotated[
        str | None,
        typer.Option("--format", help="Of the file: anipose, opencv or colmap; else by its name."),
    ] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Print the cameras that a fit estimated, with their standard deviations."""
    with talking(url) as client:
        if output is not None:
            content = client.models.calibration(model, form or _form_of(output))
            part = output.with_name(f"{output.name}.part")
            part.write_bytes(content)
            part.replace(output)
        found = client.models.cameras(model)
        say(found.raw, in_words(found), as_json=as_json)


def _form_of(file: Path) -> str:
    try:
        return FORMS[file.suffix]
    except KeyError:
        known = ", ".join(f"{form} ({suffix})" for suffix, form in FORMS.items())
        raise ValueError(f"--output: {file.name!r} names no format; there are: {known}") from None


def in_words(found: "Cameras") -> str:
    """Return the cameras as lines for people: lengths in pixels, then what was noticed."""
    rows = [HEADING, *(_row(view) for view in found.views)]
    shown = [table(rows)] if found.views else []
    return "\n".join([f"{found.arrangement}: {found.reason}", *shown, *findings_in(found.raw)])


def _row(view: "FoundCamera") -> tuple[str, ...]:
    error = view.reprojection_error
    return (
        str(view.index),
        view.camera,
        "static" if view.static else "moving",
        _numbers(view.focal, 1),
        _numbers(view.principal_point, 1),
        _numbers(None if view.distortion is None else view.distortion[:2], 3),
        "-" if error is None else f"{error:.2f}",
    )


def _numbers(values: "Float64 | None", digits: int) -> str:
    return "-" if values is None else " ".join(f"{value:.{digits}f}" for value in values)
