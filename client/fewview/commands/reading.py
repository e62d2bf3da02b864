"""What the commands that read files of keypoints have in common: options."""

from pathlib import Path
from typing import Annotated

import typer

from fewview.errors import FormatError

Files = Annotated[
    list[Path],
    typer.Argument(help="A file or folder of 2D keypoints for each camera, or all in one."),
]
Form = Annotated[
    str | None, typer.Option("--format", help="Name of the format; found out if not given.")
]
Person = Annotated[str, typer.Option(help="Of several: `auto`, a number, or the name of a track.")]
MinConfidence = Annotated[float, typer.Option(help="Detections that are less sure become gaps.")]
Skeleton = Annotated[str | None, typer.Option(help="Names the keypoints, such as `body-25b`.")]
Fps = Annotated[float | None, typer.Option(help="Frames per second.")]
ImageSize = Annotated[str | None, typer.Option(help="Of all cameras, such as `1920x1080`.")]


def size_of(text: str | None) -> tuple[int, int] | None:
    """Return the width and the height in ``1920x1080``, None for None.

    Raises
    ------
    FormatError
        If it is no such text.
    """
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise FormatError(f"--image-size {text}: expected WIDTHxHEIGHT, such as 1920x1080")
    return int(width), int(height)
