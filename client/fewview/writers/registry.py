"""The one list of the formats that animations are written in."""

from dataclasses import dataclass
from importlib import import_module
from os import PathLike
from pathlib import Path

from fewview.animation import Animation
from fewview.errors import FormatError


@dataclass(frozen=True)
class Format:
    """A format: its name, how its files' names end, and the module with its `write`."""

    name: str
    suffix: str
    module: str
    about: str


# Where a name ends in two of the suffixes, the first counts.
FORMATS = (
    Format("csv-tidy", ".tidy.csv", "csv_tidy", "CSV with a row for each point of each frame"),
    Format("csv", ".csv", "csv_wide", "CSV with a row for each frame"),
    Format("trc", ".trc", "trc", "markers for OpenSim"),
    Format("opensim-markers", ".markers.xml", "marker_set", "where OpenSim's models have them"),
    Format("c3d", ".c3d", "c3d", "markers for biomechanics"),
    Format("jsonl", ".jsonl", "json_lines", "JSON lines, one a frame"),
    Format("npz", ".npz", "npz", "arrays for NumPy"),
    Format("safetensors", ".safetensors", "safetensors", "arrays for any language"),
    Format("bvh", ".bvh", "bvh", "skeleton for animation, where edges form a tree"),
    Format("glb", ".glb", "glb", "glTF 2.0: animated points and sticks, for viewers and Blender"),
    Format("nwb", ".nwb", "nwb", "Neurodata Without Borders with ndx-pose (needs pynwb)"),
    Format("movement", ".nc", "movement", "netCDF for movement and xarray"),
    Format("deeplabcut", ".dlc3d.h5", "deeplabcut", "DeepLabCut's table of points in 3D"),
    Format("sleap", ".analysis.h5", "sleap", "SLEAP's analysis file, of points in 3D"),
    Format("parquet", ".parquet", "parquet", "table with a row for each point (needs pyarrow)"),
)


def write(path: str | PathLike[str], animation: Animation, format: str | None = None) -> Path:
    """Write an animation in the format that is named, or that the file's name ends in.

    Returns the path of the file.

    Raises
    ------
    FormatError
        If there is no such format, or it cannot hold the animation; nothing is written then.
    """
    path = Path(path)
    module = import_module(f"fewview.writers.{_choose(path, format).module}")
    module.write(path, animation)
    return path


def _choose(path: Path, name: str | None) -> Format:
    for known in FORMATS:
        if known.name == name if name else path.name.lower().endswith(known.suffix):
            return known
    listed = ", ".join(f"{known.name} ({known.suffix})" for known in FORMATS)
    asked = f"no format {name!r}" if name else f"no format of {path.name!r} by its ending"
    raise FormatError(f"{asked}; there are: {listed}")
