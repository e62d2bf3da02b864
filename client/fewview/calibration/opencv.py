"""YAML and JSON of OpenCV's `cv::FileStorage`.

OpenCV has matrices but no layout for several cameras. Written are `cameras`, a list of maps with
`name`, `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` (as OpenCV's own
calibration sample calls them), `rotation` (3x3), `translation` (3x1) and `fisheye` (0 or 1); what
is unknown is left out. Read are such lists, a map of cameras by their names, and files of one
camera; with `K`, `D`, `R`, `T` and the like for names, Rodrigues vectors for rotations, and plain
lists for matrices.

Source: OpenCV documentation, "File Input and Output using XML / YAML / JSON files".
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fewview.calibration.camera import Camera, rotation_matrix
from fewview.calibration.documents import json_of, text_of, yaml_of
from fewview.errors import FormatError

Float64 = NDArray[np.float64]

# Whatever their case, and underscores in them; among them those of OpenCV's samples and tutorials,
# of ROS and of the Panoptic Studio.
NAMES = {
    "matrix": ("cameramatrix", "matrix", "k", "m", "mtx", "intrinsicmatrix"),
    "distortion": (
        "distortioncoefficients",
        "distcoeffs",
        "distcoeff",
        "distcoefs",
        "distcoef",
        "distortions",
        "distortion",
        "dist",
        "d",
    ),
    "rotation": (
        "rotation",
        "rotationmatrix",
        "r",
        "rvec",
        "rotationvector",
        "rodrigues",
        "rot",
    ),
    "translation": ("translation", "translationvector", "tvec", "t"),
    "pose": ("extrinsics", "extrinsic", "extrinsicmatrix", "rt", "w2c"),
    "size": ("resolution", "imagesize", "size"),
}
LIKE_POSES = ("extrinsic", "pose", "rot", "transform", "c2w", "rvec")  # in names that are not known
BOARDS = ("extrinsicparameters", "rvecs")  # which OpenCV found a lens with: not the camera's pose
PINHOLES = ("", "pinhole", "perspective", "opencv", "plumbbob", "rationalpolynomial", "radtan")
FISHEYES = ("fisheye", "equidistant")  # OpenCV's and ROS's name of the same


def read(path: Path) -> list[Camera]:
    """Return the cameras of a file."""
    fields = _parsed(path)
    if isinstance(fields, list) and fields and all(isinstance(camera, dict) for camera in fields):
        fields = {"cameras": fields}
    if not isinstance(fields, dict):
        raise FormatError("expected a map, as cv::FileStorage writes it", place=path)
    if _get(fields, "matrix") is not None:
        return [_camera(str(fields.get("name", path.stem)), fields)]
    cameras = fields.get("cameras", fields)
    if isinstance(cameras, list):
        return [
            _camera(str(camera.get("name", place)), camera) for place, camera in enumerate(cameras)
        ]
    return [
        _camera(str(name), camera)
        for name, camera in cameras.items()
        if isinstance(camera, dict) and _get(camera, "matrix") is not None
    ]


def _parsed(path: Path) -> Any:
    """Parse a file into maps, lists and matrices."""
    text = text_of(path)
    return (json_of if text.lstrip().startswith(("{", "[")) else yaml_of)(path, text)


def _get(fields: dict[str, Any], part: str) -> Float64 | None:
    """Return an array under any of its names, None if it has none of them."""
    known = {_plain(key): value for key, value in reversed(fields.items())}
    for name in NAMES[part]:
        value = known.get(name)
        if isinstance(value, dict) and "data" in value:
            shape = value["sizes"] if "sizes" in value else (value["rows"], value["cols"])
            return np.array(value["data"], dtype=np.float64).reshape([int(n) for n in shape])
        if isinstance(value, list):
            return np.array(value, dtype=np.float64)
    return None


def _plain(name: object) -> str:
    return str(name).replace("_", "").lower()


def _camera(name: str, fields: dict[str, Any]) -> Camera:
    matrix, distortion = _get(fields, "matrix"), _get(fields, "distortion")
    if matrix is None:
        raise FormatError(f"camera {name!r} has no camera_matrix")
    other = [key for key, value in fields.items() if "dist" in key.lower() and not _is_word(value)]
    if distortion is None and other:
        raise FormatError(
            f"camera {name!r} has {other[0]!r}, which is not understood: OpenCV's coefficients are "
            "called distortion_coefficients"
        )
    rotation, translation = _pose(name, fields)
    width, height = fields.get("image_width"), fields.get("image_height")
    size = _get(fields, "size")
    if size is not None and not (width and height):
        width, height = size.ravel()
    return Camera(
        name,
        matrix,
        np.empty(0) if distortion is None else distortion.ravel(),
        rotation,
        translation,
        (int(width), int(height)) if width and height else None,
        _is_fisheye(name, fields),
    )


def _pose(name: str, fields: dict[str, Any]) -> tuple[Float64 | None, Float64 | None]:
    """Return rotation (3, 3) and translation (3,) from room to camera, in the file's unit, or None.

    Raises
    ------
    FormatError
        If a pose has a name or a shape that is not understood.
    """
    rotation, translation = _get(fields, "rotation"), _get(fields, "translation")
    if rotation is not None:
        return rotation_matrix(rotation) if rotation.size == 3 else rotation, translation
    pose = _get(fields, "pose")
    whole = pose is not None and pose.shape in {(3, 4), (4, 4)}
    if translation is None and pose is not None and whole and (pose[3:] == np.eye(4)[3]).all():
        return pose[:3, :3], pose[:3, 3]
    for key, value in fields.items():
        plain = _plain(key)
        like = plain in NAMES["pose"] or any(part in plain for part in LIKE_POSES)
        if like and plain not in BOARDS and isinstance(value, dict | list):
            raise FormatError(
                f"camera {name!r} has {key!r}, which is not understood: call the pose rotation "
                "(3x3 or Rodrigues) and translation, room to camera"
            )
    return None, translation


def _is_word(value: Any) -> bool:
    return value is None or isinstance(value, str | bool)


def _is_fisheye(name: str, fields: dict[str, Any]) -> bool:
    model = str(fields.get("distortion_model") or "")
    if _plain(model) not in PINHOLES + FISHEYES:
        raise FormatError(f"camera {name!r} has the distortion model {model!r}, not OpenCV's")
    return bool(fields.get("fisheye", False)) or _plain(model) in FISHEYES


def write(path: Path, cameras: Sequence[Camera]) -> None:
    """Write cameras as JSON where the name ends so, otherwise as YAML."""
    listed = [_as_document(camera) for camera in cameras]
    if path.suffix.lower() == ".json":
        text = json.dumps({"cameras": listed}, indent=4, ensure_ascii=False)
    else:
        text = "%YAML:1.0\n---\ncameras:\n" + "".join(_yaml(camera) for camera in listed)
    path.write_text(text.rstrip("\n") + "\n", encoding="utf-8", newline="\n")


def _as_document(camera: Camera) -> dict[str, Any]:
    """Return a camera in the JSON form of cv::FileStorage."""
    fields: dict[str, Any] = {"name": camera.name}
    if camera.size is not None:
        fields |= {"image_width": camera.size[0], "image_height": camera.size[1]}
    fields["camera_matrix"] = _matrix(camera.matrix)
    fields["distortion_coefficients"] = _matrix(camera.distortion[:, None])
    if camera.rotation is not None and camera.translation is not None:
        fields["rotation"] = _matrix(camera.rotation)
        fields["translation"] = _matrix(camera.translation[:, None])
    return fields | {"fisheye": int(camera.fisheye)}


def _matrix(values: Float64) -> dict[str, Any]:
    rows, columns = values.shape
    data = values.ravel().tolist()
    return {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": data}


def _yaml(fields: dict[str, Any]) -> str:
    """Return a camera as an entry of a list in YAML."""
    lines = ["   -"]
    for name, value in fields.items():
        if isinstance(value, dict):
            lines.append(f"      {name}: !!opencv-matrix")
            lines += [f"         {part}: {value[part]}" for part in ("rows", "cols", "dt", "data")]
        else:
            lines.append(f"      {name}: {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"
