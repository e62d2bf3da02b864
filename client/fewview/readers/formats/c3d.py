"""C3D with 2D points of one camera: x and y in pixels, z nowhere."""

import numpy as np

from fewview.errors import FormatError
from fewview.readers.sources import Source, check_size
from fewview.readers.views import View

MAX_C3D = 2**30  # bytes


def fits(source: Source) -> bool:
    """Whether this is a C3D file: its second byte is always 80."""
    return not source.frames and source.head[1:2] == b"\x50" and 1 <= source.head[0] <= 32


def read(source: Source) -> list[View]:
    """Return the view of a file.

    Raises
    ------
    FormatError
        If it cannot be read, or its points have a z.
    """
    import ezc3d  # noqa: PLC0415 (heavy)

    check_size(source.path, MAX_C3D)
    try:
        content = ezc3d.c3d(str(source.path))
        points = np.asarray(content["data"]["points"], np.float32)
        labels = [str(label) for label in content["parameters"]["POINT"]["LABELS"]["value"]]
        rate = float(content["parameters"]["POINT"]["RATE"]["value"][0])
    except (OSError, RuntimeError, KeyError, IndexError, ValueError) as error:
        raise FormatError(f"a C3D file that cannot be read ({error})", place=source) from error
    _, count, frames = points.shape
    if not count or not frames:
        raise FormatError("a C3D file without points", place=source)
    z = points[2]
    if np.any(np.isfinite(z) & (z != 0)):
        raise FormatError(
            "a C3D file of 3D points; Fewview makes 3D from the 2D keypoints of each "
            "camera: give those",
            place=source,
        )
    numbers = np.arange(frames)
    return [
        View(
            source.name,
            points[:2].transpose(2, 1, 0)[:, None],
            numbers,
            people=("",),
            keypoint_names=tuple(labels[:count]) if len(set(labels[:count])) == count else None,
            times=numbers / rate if rate > 0 else None,
        )
    ]
