"""The cameras of a model as calibration files of other tools."""

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from fewview.calibration import from_model, write_cameras
from typing_extensions import TypeAliasType

from service.wire.cameras import ModelCameras

CalibrationFormat = TypeAliasType(
    "CalibrationFormat", Literal["json", "anipose", "opencv", "colmap"]
)
Size = tuple[int, int]


class _Kind(NamedTuple):
    filename: str
    media_type: str


KINDS = {
    "anipose": _Kind("cameras.toml", "application/toml"),
    "opencv": _Kind("cameras.yml", "application/yaml"),
    "colmap": _Kind("colmap.zip", "application/zip"),
}
MEDIA_TYPES = tuple(kind.media_type for kind in KINDS.values())


class CalibrationFile(NamedTuple):
    """A file, and how it travels."""

    content: bytes
    filename: str
    media_type: str


def calibration_file(
    cameras: ModelCameras,
    format: str,
    names: Sequence[str] | None,
    sizes: Sequence[Size | None] | None,
) -> CalibrationFile:
    """Return the cameras as a file; COLMAP's three text files are in a zip.

    Parameters
    ----------
    names
        Of the views; None, or some that are alike, for view0, view1, ...
    sizes
        (width, height) of each view in pixels, None where unknown.

    Raises
    ------
    ValueError
        If the format cannot describe these cameras; the message has the reason.
    """
    if not cameras.views:
        raise ValueError(f"no cameras were found: {cameras.reason}")
    kind = KINDS[format]
    with TemporaryDirectory() as folder:
        target = Path(folder, "colmap" if format == "colmap" else kind.filename)
        if names and len(set(names)) < len(names):
            names = None
        if names and format == "colmap":  # which knows no blanks
            names = [re.sub(r"\s", "_", name) for name in names]
        found = from_model(cameras.model_dump(mode="json"), names, sizes)
        write_cameras(target, found, format)
        content = _zipped(target) if format == "colmap" else target.read_bytes()
    return CalibrationFile(content, kind.filename, kind.media_type)


def _zipped(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    return buffer.getvalue()
