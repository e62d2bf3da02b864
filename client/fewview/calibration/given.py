"""Given cameras of a fit: those of a calibration file, assigned to the views."""

import re
from collections.abc import Sequence
from os import PathLike
from typing import Any

from fewview.calibration.camera import Camera
from fewview.calibration.files import read_cameras
from fewview.errors import FormatError

# Endings of images, as COLMAP names cameras, and of videos.
_BETWEEN = re.compile(r"[\s._-]")
MEDIA = re.compile(r"\.(png|jpe?g|bmp|tiff?|mp4|avi|mov|mkv|m4v|webm)$", re.IGNORECASE)


def read_for_views(
    file: str | PathLike[str], names: Sequence[str] | None, views: int
) -> tuple[list[Camera], str]:
    """Return a calibration file's cameras of a capture's views, as `for_views` does.

    Parameters
    ----------
    names
        Of the views; None where they have none, and their order counts.
    views
        How many there are.

    Raises
    ------
    FormatError
        If the file cannot be read, or its cameras do not fit the views.
    """
    return for_views(read_cameras(file), names or [f"view {view + 1}" for view in range(views)])


def for_views(cameras: Sequence[Camera], names: Sequence[str]) -> tuple[list[Camera], str]:
    """Return the cameras of the views, and how they were found, in a sentence for people.

    They are found by their names, where these are the views' (whatever their case, the ending of an
    image or a video, and blanks, dots, dashes and underscores in them), so a file may have cameras
    that are not needed; else by their order.

    Raises
    ------
    FormatError
        If only some views have a camera of their name, or, where none has, there are more or
        fewer cameras than views.
    """
    by_name = {_plain(camera.name): camera for camera in cameras}
    found = [by_name.get(_plain(name)) for name in names]
    matched = [camera for camera in found if camera is not None]
    called = ", ".join(camera.name for camera in cameras)
    distinct = len(by_name) == len(cameras) and len({_plain(name) for name in names}) == len(names)
    if distinct and matched and len(matched) == len(names):
        return matched, f"cameras are those of the calibration with the views' names: {called}"
    if distinct and matched:
        missing = next(name for name, camera in zip(names, found, strict=True) if camera is None)
        raise FormatError(
            f"the calibration has no camera {missing!r}: its cameras are {called}, the views are "
            f"{', '.join(names)}; give them the same names, or names that all differ"
        )
    if len(cameras) != len(names):
        raise FormatError(
            f"the calibration has {len(cameras)} cameras ({called}), and there are {len(names)} "
            f"views ({', '.join(names)})"
        )
    return list(cameras), f"cameras of the calibration are taken in the order of views: {called}"


def sizes_for(file: str | PathLike[str], names: Sequence[str]) -> list[tuple[int, int] | None]:
    """Return the image sizes that a calibration file has for the views, None where it has none.

    Raises
    ------
    FormatError
        If the file cannot be read, or its cameras do not fit the views.
    """
    return [camera.size for camera in for_views(read_cameras(file), names)[0]]


def as_config(camera: Camera) -> dict[str, Any]:
    """Return a camera as an entry of a fit's ``calibration``.

    Raises
    ------
    FormatError
        If its pixels are skewed, which the service does not know.
    """
    (fx, skew, cx), (_, fy, cy) = camera.matrix[:2].tolist()
    if skew:
        raise FormatError(f"camera {camera.name!r} has skewed pixels, which no fit supports")
    config: dict[str, Any] = {
        "intrinsics": {
            "model": "fisheye" if camera.fisheye else "pinhole",
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "distortion": camera.distortion.tolist(),
        }
    }
    if camera.rotation is not None and camera.translation is not None:
        config["rotation"] = camera.rotation.tolist()
        config["translation"] = camera.translation.tolist()
    return config


def _plain(name: str) -> str:
    return _BETWEEN.sub("", MEDIA.sub("", name)).casefold()
