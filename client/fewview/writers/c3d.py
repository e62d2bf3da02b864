"""C3D, the markers of biomechanics, by ezc3d.

Points are float32; a missing point has the residual -1. The rate is constant.

Source: "The C3D File Format, A Technical User Guide", Motion Lab Systems, 2021.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.numbers import evened

MOST_FRAMES = 65535  # the header counts in 16 bits
LONGEST = 127  # characters of a label


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
    count, frames = animation.points.shape[1::-1]
    points = np.full((4, count, frames), np.nan)
    points[:3] = animation.points.transpose(2, 1, 0)
    points[3] = 1
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [animation.rate]
    point["UNITS"]["value"] = [animation.unit or ""]
    point["LABELS"]["value"] = list(animation.names)
    file["data"]["points"] = points
    file["data"]["meta_points"] = {
        "residuals": np.where(animation.seen.T, 0.0, -1.0)[None],
        "camera_masks": np.zeros((7, count, frames), dtype=bool),
    }
    with TemporaryDirectory() as folder:  # ezc3d gives every name the ending .c3d
        written = Path(folder, "animation.c3d")
        file.write(str(written))
        path.write_bytes(written.read_bytes())
