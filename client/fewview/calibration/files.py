"""The one list of the formats of calibrations."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path
from types import ModuleType

import numpy as np

from fewview.calibration.camera import Camera
from fewview.calibration.plausible import check
from fewview.errors import FormatError


@dataclass(frozen=True)
class Format:
    """A format: its name, how its files' names end, and the module with its `read` and `write`."""

    name: str
    suffixes: tuple[str, ...]
    module: str
    about: str


FORMATS = (
    Format("anipose", (".toml",), "anipose", "TOML of Anipose, Pose2Sim, FreeMoCap, caliscope"),
    Format("opencv", (".yml", ".yaml", ".json"), "opencv", "YAML or JSON of cv::FileStorage"),
    Format("colmap", ("",), "colmap", "a folder with COLMAP's cameras.txt and images.txt"),
)


def read_cameras(path: str | PathLike[str], format: str | None = None) -> list[Camera]:
    """Return the cameras of a calibration file, or of a folder of COLMAP's, in its order.

    Raises
    ------
    FormatError
        If there is no such format, or the file is not of this format, is beyond the bounds of
        `documents`, or its cameras are none (`plausible`).
    OSError
        If it cannot be read.
    """
    path = Path(path)
    try:
        found: list[Camera] = _module(path, format).read(path)
    except FormatError:
        raise
    except (
        *(ValueError, KeyError, TypeError, IndexError, AttributeError),
        *(OverflowError, np.linalg.LinAlgError),
    ) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise FormatError(reason, place=path) from error
    if not found:
        raise FormatError("has no cameras", place=path)
    check(path, found)
    return found


def write_cameras(
    path: str | PathLike[str], cameras: Sequence[Camera], format: str | None = None
) -> Path:
    """Write cameras as a calibration file, or a folder of COLMAP's; return the path.

    Raises
    ------
    FormatError
        If there is no such format, or it cannot describe these cameras.
    """
    path = Path(path)
    if not cameras:
        raise FormatError("there are no cameras to write")
    names = [camera.name for camera in cameras]
    if len(set(names)) < len(names):
        raise FormatError(f"cameras need names that differ, these are {names}")
    module = _module(path, format)
    try:
        module.write(path, cameras)
    except FormatError:
        raise
    except ValueError as error:  # more coefficients than the format has
        raise FormatError(str(error)) from error
    return path


def _module(path: Path, name: str | None) -> ModuleType:
    folder = path.is_dir() or path.name in {"cameras.txt", "images.txt"}
    ending = "" if folder else path.suffix.lower()
    for known in FORMATS:
        if known.name == name if name else ending in known.suffixes:
            return import_module(f"fewview.calibration.{known.module}")
    listed = ", ".join(f"{known.name} ({known.about})" for known in FORMATS)
    asked = f"no format {name!r}" if name else f"no format of {path.name!r} by its ending"
    raise FormatError(f"{asked}; there are: {listed}")
