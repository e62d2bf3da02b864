"""Calibrations: those that come with a capture, and the cameras of a model as files."""

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, NamedTuple

from fewview.calibration import from_model, write_cameras
from fewview.capture import CameraCalibration
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import TypeAliasType

from models.settings.calibration import Camera
from models.settings.keypoints import MAX_VIEWS
from service.wire.cameras import FitCameras, ModelCameras

CalibrationFormat = TypeAliasType(
    "CalibrationFormat", Literal["json", "anipose", "opencv", "colmap"]
)
Size = tuple[int, int]
LONGEST_NAME = 200


class CaptureCalibration(BaseModel):
    """The cameras that came with a capture: a fit uses them if it names them."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "file": "calibration.toml",
                "names": ["left", "right"],
                "cameras": [
                    {"intrinsics": {"fx": 1104.5, "cx": 640.2, "cy": 511.7, "distortion": []}},
                    None,
                ],
            }
        },
    )

    file: str = Field("", max_length=200, description="Name of the file that they are from.")
    names: list[Annotated[str, Field(max_length=200)]] | None = Field(
        None, max_length=MAX_VIEWS, description="What the file calls the cameras of the views."
    )
    cameras: list[Camera | None] = Field(
        min_length=1,
        max_length=MAX_VIEWS,
        description="One per view, as in `calibration` of a fit's `config`; null where unknown.",
    )


def checked_calibration(found: CameraCalibration, notes: list[str]) -> dict[str, Any] | None:
    """Return a file's cameras as a JSON object; None, and a note, if no fit could use them."""
    names = [name[:LONGEST_NAME] for name in found.names]
    fields = {"file": found.file[:LONGEST_NAME], "names": names, "cameras": found.cameras}
    try:
        known = CaptureCalibration.model_validate(fields)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        notes.append(f"{found.file}: a calibration, which was left out: {place}: {first['msg']}")
        return None
    return known.model_dump(mode="json")


class _Kind(NamedTuple):
    filename: str
    media_type: str


_BLANK = re.compile(r"\s")
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
    cameras: ModelCameras | FitCameras,
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
            names = [_BLANK.sub("_", name) for name in names]
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
