"""DeepLabCut's 3D H5, as its triangulation writes it: a scorer, body parts, x, y and z."""

from pathlib import Path

import numpy as np

from fewview.animation import Animation
from fewview.writers.labels.pandas_h5 import write_frame

LEVELS, SCORER = ("scorer", "bodyparts", "coords"), "Fewview"


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a table of pandas; a missing point is NaN."""
    columns = [(SCORER, name, axis) for name in animation.names for axis in "xyz"]
    values = animation.points.reshape(len(animation.points), -1)
    write_frame(path, LEVELS, columns, np.array(animation.frames, np.int64), values)
