"""Structures as files of other tools, by the writers of the client."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import numpy as np
from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.registry import FORMATS, write
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from service.http.errors import invalid
from service.wire.skeletons import Skeleton

AnimationFormat = TypeAliasType(
    "AnimationFormat", Literal["trc", "c3d", "bvh", "glb", "csv", "csv-tidy"]
)
LengthUnit = TypeAliasType("LengthUnit", Literal["m", "mm"])
SUFFIXES = {known.name: known.suffix for known in FORMATS}


class AnimationFile(NamedTuple):
    """A file, and how its name ends."""

    content: bytes
    suffix: str


def animation_file(
    points: NDArray[np.float32],
    points_sd: NDArray[np.float32] | None,
    skeleton: Skeleton,
    *,
    format: AnimationFormat,
    unit: LengthUnit | None,
    fps: float | None,
    times: NDArray[np.float64] | None,
) -> AnimationFile:
    """Return points (N, P, 3), with how far they may be off (N, P), at `times` (N,) as a file.

    Times are in seconds.

    Raises
    ------
    ApiError
        422 with the reason why the format cannot hold them.
    """
    names = skeleton.keypoint_names
    try:
        animation = Animation(
            points=points.astype(np.float64),
            unit=unit,
            fps=fps,
            times=times,
            keypoint_names=None if names is None else tuple(names),
            edges=tuple((first, second) for first, second in skeleton.edges),
            points_sd=None if points_sd is None else points_sd.astype(np.float64),
        )
        with TemporaryDirectory() as folder:
            target = Path(folder, f"animation{SUFFIXES[format]}")
            write(target, animation, format)
            return AnimationFile(target.read_bytes(), SUFFIXES[format])
    except FormatError as error:
        field = error.option or "format"
        raise invalid(f"/{field}", error.worded("", f"{field}={error.remedy}")) from error
    except ValueError as error:
        raise invalid("/format", str(error)) from error
