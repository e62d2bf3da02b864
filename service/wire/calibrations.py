"""The cameras of a model as calibration files of other tools."""

import io
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
    cameras: ModelCameras, format: str, sizes: Sequence[Size | None] | None
) -> CalibrationFile:
    """Return the cameras as a file; COLMAP's three text files are in a zip.

    Parameters
    ----------
    sizes
        (width, height) of each view in pixels, None where unknown.

    Raises
    ------
    ValueError
        If the format cannot say these cameras; the message says why.
    """
    if not cameras.views:
        raise ValueError(f"no cameras were found: {cameras.reason}")
    kind = KINDS[format]
    with TemporaryDirectory() as folder:
        target = Path(folder, "colmap" if format == "colmap" else kind.filename)
        found = from_model(cameras.model_dump(mode="json"), sizes=sizes)
        write_cameras(target, found, format)
        content = _zipped(target) if format == "colmap" else target.read_bytes()
    return CalibrationFile(content, kind.filename, kind.media_type)


def _zipped(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    return buffer.getvalue()
