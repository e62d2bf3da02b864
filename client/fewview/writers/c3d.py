"""C3D, the markers of biomechanics, by ezc3d.

Points are float32. The residual of a point is how far it may be off, in 1 to 255 steps of
POINT:SCALE in the unit of the points; 0 if that is unknown, -1 if the point is missing. No point
has a mask of cameras. The rate is constant.

Source: "The C3D File Format, A Technical User Guide", Motion Lab Systems, 2021.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.numbers import evened

MOST_FRAMES = 65535  # the header counts in 16 bits
LONGEST = 127  # characters of a label
MOST_STEPS = 255  # of a residual, which has 8 bits
LARGEST_INTEGER = 32000  # a coordinate in steps, where a tool converts the file to integers


def write(path: Path, animation: Animation) -> None:
    """Write an animation as markers.

    Raises
    ------
    FormatError
        If its times are uneven, a name is too long, or it has no frame or too many.
    """
    import ezc3d  # noqa: PLC0415  # takes a while to load

    animation = evened(animation, "C3D")
    if not animation.points.size:
        raise FormatError("C3D holds one point of one frame at least")
    if len(animation.points) > MOST_FRAMES:
        raise FormatError(f"C3D holds {MOST_FRAMES} frames at most: write parts")
    if any(len(name.encode()) > LONGEST for name in animation.names):
        raise FormatError(f"names in C3D have {LONGEST} bytes at most")
    scale = _scale(animation)
    count, frames = animation.points.shape[1::-1]
    points = np.full((4, count, frames), np.nan)
    points[:3] = animation.points.transpose(2, 1, 0)
    points[3] = 1
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [animation.rate]
    point["UNITS"]["value"] = [animation.unit or ""]
    point["SCALE"]["value"] = [-scale]  # negative: points are floats
    point["LABELS"]["value"] = list(animation.names)
    file["data"]["points"] = points
    with TemporaryDirectory() as folder:  # ezc3d gives every name the ending .c3d
        written = Path(folder, "animation.c3d")
        file.write(str(written))
        content = bytearray(written.read_bytes())
    _write_residuals(content, animation, scale)
    path.write_bytes(content)


def _scale(animation: Animation) -> float:
    """Return the step of residuals, in which coordinates fit into integers, too."""
    steps = [np.abs(animation.points[animation.seen]).max(initial=0) / LARGEST_INTEGER]
    if animation.points_sd is not None:
        steps.append(np.nanmax(animation.points_sd) / MOST_STEPS)
    return float(np.float32(max(steps))) or 1.0


def _write_residuals(content: bytearray, animation: Animation, scale: float) -> None:
    """Write scale and residuals into a file of ezc3d, which has 1.0 and puts residuals elsewhere.

    It takes the upper byte of the fourth word of a point for the residual, where the guide has the
    mask of cameras (seen in 1.7.2).
    """
    header = np.frombuffer(content, "<u2", count=10)
    np.frombuffer(content, "<f4", count=1, offset=12)[:] = -scale
    frames, count = animation.seen.shape
    words: NDArray[np.float32] = np.frombuffer(
        content, "<f4", count=frames * count * 4, offset=512 * (int(header[8]) - 1)
    ).reshape(frames, count, 4)
    steps = np.zeros((frames, count))
    if animation.points_sd is not None:
        steps = np.nan_to_num(np.clip(np.rint(animation.points_sd / scale), 1, MOST_STEPS))
    words[..., 3] = np.where(animation.seen, steps, -1)
