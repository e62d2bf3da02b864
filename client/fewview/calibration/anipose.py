"""TOML as aniposelib writes it, and its flavours: Pose2Sim, FreeMoCap, caliscope.

A section for each camera, `[cam_0]`, or of its own name (Pose2Sim), or `[cameras.0]` (caliscope):
`name` (caliscope: `port` or `cam_id`), `size`, `matrix`, `distortions`, `rotation` (a Rodrigues
vector, or 3x3), `translation`, `fisheye`. Sections without a `matrix` and other keys are ignored.
Where all sections end in numbers they are read in the order of these, else in that of the file.

Pixels and axes are OpenCV's. Sources: aniposelib 0.8, cameras.py; Pose2Sim 0.10,
calibration.py; caliscope's camera_array.toml.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fewview.calibration.camera import Camera, rotation_matrix
from fewview.calibration.documents import text_of, toml_of
from fewview.errors import FormatError

_LAST_NUMBER = re.compile(r"(?<!\d)\d+$")


def read(path: Path) -> list[Camera]:
    """Return the cameras of a file."""
    fields = toml_of(path, text_of(path))
    sections = {**fields, **fields.get("cameras", {})}
    found = {
        name: section
        for name, section in sections.items()
        if isinstance(section, dict) and _or_none(section.get("matrix")) is not None
    }
    numbers = [_LAST_NUMBER.search(name) for name in found]
    order = list(found)
    if all(numbers):
        order.sort(key=lambda name: int(_LAST_NUMBER.findall(name)[0][-18:]))
    return [_camera(name, found[name]) for name in order]


def _camera(section: str, fields: dict[str, Any]) -> Camera:
    named = (fields.get(key) for key in ("name", "cam_id", "port"))
    name = next((str(value) for value in named if value is not None), section)
    rotation, translation = _or_none(fields.get("rotation")), _or_none(fields.get("translation"))
    if rotation is not None and np.size(rotation) == 3:
        rotation = rotation_matrix(rotation)
    size = _or_none(fields.get("size"))
    return Camera(
        name,
        fields["matrix"],
        np.ravel(_or_none(fields.get("distortions")) or []),
        rotation,
        translation,
        None if size is None else (round(size[0]), round(size[1])),
        bool(fields.get("fisheye", False)),
    )


def _or_none(value: Any) -> Any:
    """Return a value, or None for those that mean none in TOML."""
    return None if isinstance(value, str) else value


def write(path: Path, cameras: Sequence[Camera]) -> None:
    """Write cameras as aniposelib reads them; sections are numbered so that sorting keeps order.

    Raises
    ------
    FormatError
        If a camera has no pose or no size.
    """
    digits = len(str(len(cameras) - 1))
    lines = []
    for place, camera in enumerate(cameras):
        if camera.vector is None or camera.translation is None:
            raise FormatError(f"camera {camera.name!r} has no pose, which this format needs")
        if camera.size is None:
            raise FormatError(
                f"camera {camera.name!r} has no image size: this format needs that of the capture",
                option="image_size",
                remedy="WIDTHxHEIGHT",
            )
        values = {
            "name": camera.name,
            "size": list(camera.size),
            "matrix": camera.matrix.tolist(),
            "distortions": camera.distortion.tolist(),
            "rotation": camera.vector.tolist(),
            "translation": camera.translation.tolist(),
            "fisheye": camera.fisheye,
        }
        lines.append(f"[cam_{place:0{digits}}]")
        # JSON is TOML for strings, booleans, lists and finite numbers.
        lines += [f"{key} = {json.dumps(value)}" for key, value in values.items()]
        lines.append("")
    lines += ["[metadata]", "adjusted = false", "error = 0.0", ""]
    path.write_text("\n".join(lines), encoding="utf-8", newline="\n")
