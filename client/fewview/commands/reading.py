"""What the commands that read files of keypoints have in common: their options."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Concatenate, Literal, ParamSpec, get_type_hints

import typer

from fewview.reading_options import Align, ReadingOptions

P = ParamSpec("P")
Options = Callable[[], ReadingOptions]

Files = Annotated[
    list[Path],
    typer.Argument(help="A file or folder of 2D keypoints for each camera, or all in one."),
]
OPTIONS: dict[str, Any] = {
    "format": Annotated[
        str | None, typer.Option(help="Name of the format; found out if not given.")
    ],
    "person": Annotated[
        str,
        typer.Option(
            help="Of several: `auto`, a number (0 is seen most), the name of a track, or one for "
            "each camera, such as `0,1,0`."
        ),
    ],
    "min_confidence": Annotated[
        float, typer.Option(help="Detections that are less sure become gaps.")
    ],
    "skeleton": Annotated[
        str | None, typer.Option(help="Names the keypoints, such as `body-25b`.")
    ],
    "align": Annotated[
        Align, typer.Option(help="What belongs together: numbers (index), times, or found out.")
    ],
    "fps": Annotated[
        str | None,
        typer.Option(help="Frames per second of all cameras, or `cam1=60,cam2=30`."),
    ],
    "image_size": Annotated[
        str | None,
        typer.Option(
            "--image-size",
            "--size",
            help="Of all cameras, such as `1920x1080`, or `1920x1080,cam2=1080x1920`.",
        ),
    ],
    "columns": Annotated[
        str | None,
        typer.Option(help="What columns of a table hold, such as `x={}_x,y={}_y,frame=No`."),
    ],
    "cameras": Annotated[
        str | None, typer.Option(help="Views to use, in this order: `cam1,cam2`.")
    ],
    "trial": Annotated[
        str | None, typer.Option(help="The trial to read, where files are of several.")
    ],
    "y": Annotated[
        Literal["down", "up"], typer.Option(help="`up` where y counts from the lower edge.")
    ],
    "mirror": Annotated[
        str | None,
        typer.Option(help="Which views show mirror images, such as `cam2`; `none` if none does."),
    ],
    "offset": Annotated[
        str | None,
        typer.Option(help="The corner of a crop that keypoints count from: `cam2=560,180`."),
    ],
    "offset_seconds": Annotated[
        str | None,
        typer.Option(help="How much later views show every moment: `cam2=4.2`; earlier: `-4.2`."),
    ],
    "views_in_names": Annotated[
        str | None,
        typer.Option(
            help="Words of cameras in keypoints' names: `real,mirror`; `none` if there are none."
        ),
    ],
}


def reading_files(
    command: Callable[Concatenate[Options, P], None],
) -> Callable[P, None]:
    """Give a command the options of reading.

    Its first argument is a function that returns them, or raises ``FormatError`` where the command
    can report it.
    """
    defaults = {each.name: each.default for each in fields(ReadingOptions)}
    own = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True)
    others = list(own.parameters.values())[1:]
    parameters = [each.replace(annotation=hints[each.name]) for each in others] + [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=kind
        )
        for name, kind in OPTIONS.items()
    ]

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        options: dict[str, Any] = {name: kwargs.pop(name) for name in OPTIONS}
        command(lambda: ReadingOptions(**options), *args, **kwargs)

    run.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
