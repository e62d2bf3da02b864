"""COLMAP's text files: a folder with cameras.txt and images.txt, points3D.txt empty.

COLMAP's origin is the corner of the top-left pixel, whose centre is (0.5, 0.5); OpenCV's is that
centre. So principal points are written with 0.5 added and read with 0.5 taken off. Poses are those
of OpenCV, as quaternions (w, x, y, z) and translations. Every image becomes a camera under the
image's name; a camera without an image has no pose.

Source: COLMAP documentation, "Output Format" and "Camera Models" (src/colmap/sensor/models.h).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fewview.calibration.camera import Camera, quaternion
from fewview.calibration.documents import MAX_LINES_BYTES, text_of
from fewview.errors import FormatError

Float64 = NDArray[np.float64]

HALF = 0.5  # pixels, from OpenCV's origin to COLMAP's
# What the parameters of a model are, f for both focal lengths; k1, ... as OpenCV's distortion.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
PINHOLE_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_ORDER = ("k1", "k2", "k3", "k4")


def read(path: Path) -> list[Camera]:
    """Return the cameras of a folder, or of the folder that a file of it lies in."""
    folder = path if path.is_dir() else path.parent
    lenses = {}
    for line in _lines(folder / "cameras.txt"):
        if line:
            number, *fields = line.split()
            lenses[number] = _lens(f"camera{number}", fields)
    cameras, used = [], set()
    lines = iter(_lines(folder / "images.txt"))
    for line in lines:
        if not line:
            continue
        next(lines, None)  # the keypoints of the image, or an empty line
        _, *pose, number, name = line.split(maxsplit=9)
        lens = lenses.get(number)
        if lens is None:
            raise FormatError(
                f"image {name!r} is of camera {number}, which is missing", place=folder
            )
        turn = _rotation(np.array(pose[:4], dtype=np.float64))
        shift = np.array(pose[4:], dtype=np.float64)
        used.add(number)
        cameras.append(
            Camera(name, lens.matrix, lens.distortion, turn, shift, lens.size, lens.fisheye)
        )
    return cameras + [lens for number, lens in lenses.items() if number not in used]


def _lines(path: Path) -> list[str]:
    """Return the lines of a file without comments and the blanks around."""
    lines = [line.strip() for line in text_of(path, MAX_LINES_BYTES).splitlines()]
    return [line for line in lines if not line.startswith("#")]


def _lens(name: str, fields: list[str]) -> Camera:
    """Return a camera without a pose, from MODEL, WIDTH, HEIGHT, PARAMS."""
    model, width, height, *numbers = fields
    if model not in MODELS:
        raise FormatError(f"{name} is of COLMAP's model {model}; known are {', '.join(MODELS)}")
    if len(numbers) != len(MODELS[model]):
        raise FormatError(f"{name}: {model} has the parameters {', '.join(MODELS[model])}")
    values = dict(zip(MODELS[model], (float(number) for number in numbers), strict=True))
    fx, fy = (values.get(axis, values.get("f", 0.0)) for axis in ("fx", "fy"))
    centre = (values["cx"] - HALF, values["cy"] - HALF)
    fisheye = model.endswith("FISHEYE")
    order = FISHEYE_ORDER if fisheye else PINHOLE_ORDER
    distortion = np.array([values.get(part, 0.0) for part in order])
    matrix = np.array([[fx, 0, centre[0]], [0, fy, centre[1]], [0, 0, 1]])
    size = (int(width), int(height))
    return Camera(name, matrix, distortion, size=size, fisheye=fisheye)


def _rotation(q: Float64) -> Float64:
    """Return the rotation (3, 3) of a quaternion (4,) w, x, y, z of any length but 0."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def write(path: Path, cameras: Sequence[Camera]) -> None:
    """Write cameras into a folder, which is made; of one without a pose only the lens.

    Raises
    ------
    FormatError
        If a camera has no image size, has skew, or a name with blanks.
    """
    lenses, images = [], []
    for number, camera in enumerate(cameras, start=1):
        lenses.append(f"{number} {_model(camera)}")
        if camera.rotation is not None and camera.translation is not None:
            if camera.name.split() != [camera.name]:
                raise FormatError(f"names in COLMAP's text have no blanks: {camera.name!r}")
            pose = _numbers((*quaternion(camera.rotation), *camera.translation))
            images += [f"{number} {pose} {number} {camera.name}", ""]
    path.mkdir(parents=True, exist_ok=True)
    heads = {
        "cameras.txt": ("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", lenses),
        "images.txt": ("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", images),
        "points3D.txt": ("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]", []),
    }
    for name, (head, lines) in heads.items():
        text = "\n".join((head, *lines)) + "\n"
        (path / name).write_text(text, encoding="utf-8", newline="\n")


def _model(camera: Camera) -> str:
    """Return MODEL, WIDTH, HEIGHT and PARAMS, of the smallest model that has all coefficients."""
    if camera.size is None:
        raise FormatError(
            f"camera {camera.name!r} has no image size: COLMAP needs that of the capture",
            option="image_size",
            remedy="WIDTHxHEIGHT",
        )
    if camera.matrix[0, 1]:
        raise FormatError(f"camera {camera.name!r} has skew, which COLMAP's models have not")
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
    model, coefficients = "PINHOLE", []
    if camera.fisheye:
        model, coefficients = "OPENCV_FISHEYE", camera.distortion.tolist()
    elif np.any(camera.distortion[4:]):
        model, coefficients = "FULL_OPENCV", [*camera.distortion.tolist(), 0.0, 0.0, 0.0][:8]
    elif np.any(camera.distortion):
        model, coefficients = "OPENCV", camera.distortion[:4].tolist()
    parameters = _numbers((fx, fy, cx + HALF, cy + HALF, *coefficients))
    return f"{model} {camera.size[0]} {camera.size[1]} {parameters}"


def _numbers(values: Sequence[float]) -> str:
    """Return numbers that read back exactly."""
    return " ".join(repr(float(value)) for value in values)
