"""``fewview lift``: files of keypoints become 3D."""

from pathlib import Path
from typing import Annotated

import typer

from fewview.commands.reading import Files, Options, reading_files
from fewview.commands.talking import AsJson, Url, capture_in, echo, say, talking


@reading_files
def lift(
    options: Options,
    model: Annotated[str, typer.Argument(help="Its id, mdl_..., or an alias.")],
    files: Files,
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="The npz to write.")],
    refine: Annotated[
        str | None, typer.Option(help="`auto`, `full` or `off`; else as in the fit.")
    ] = None,
    views: Annotated[
        str | None, typer.Option(help="Which views of the fit the cameras are, such as `0,2`.")
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(help="`room`: of the static cameras; else `canonical`, of each frame."),
    ] = None,
    up: Annotated[
        str | None, typer.Option(help="Up in the room: `auto`, or a vector such as `0,-1,0`.")
    ] = None,
    uncertainty: Annotated[
        str | None,
        typer.Option(
            help="How far points may be off: `sd`, the default; `full`, with covariances and "
            "modes, for lengths and angles; `off`."
        ),
    ] = None,
    url: Url = None,
    as_json: AsJson = False,
) -> None:
    """Lift the keypoints of all cameras with a model; writes arrays."""
    import numpy as np  # noqa: PLC0415 (commands load what they need)

    with talking(url) as client:
        if output.suffix != ".npz":
            raise ValueError(f"--output: expected a file that ends in .npz, got {output.name!r}")
        found = client.lift(
            model,
            capture_in(files, options()),
            refine=refine,
            views=None if views is None else indices(views),
            frame=frame,
            up=up,
            uncertainty=uncertainty,
        )
        part = output.with_name(f"{output.name}.part")
        with part.open("wb") as file:
            np.savez(file, allow_pickle=False, **found.arrays())
        part.replace(output)
        frames, lifted = len(found), int(found.lifted.sum())
        for finding in found.findings:
            line = f"{finding.severity}: {finding.code}. {finding.effect} {finding.remedy}"
            echo(line, err=True)
        result = {
            "file": str(output),
            "frames": frames,
            "frames_lifted": lifted,
            "findings": [finding.code for finding in found.findings],
        }
        say(result, f"{lifted} of {frames} frames lifted: {output}", as_json=as_json)


def indices(text: str) -> list[int]:
    """Return the numbers of views in a text such as ``0,2``."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ValueError(f"--views: expected numbers such as 0,2, got {text!r}") from error
