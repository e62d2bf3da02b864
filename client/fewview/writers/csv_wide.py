"""CSV with a row for each frame: frame, time, then x, y, z, sd of every keypoint.

Frames have the numbers of the files, or count from 0; time (seconds) and sd (how far the point may
be off) are left out where they are unknown. A missing point is empty. Comma and CRLF as in RFC
4180.
"""

from pathlib import Path

import numpy as np

from fewview.animation import Animation
from fewview.plain import TableWriter
from fewview.writers.numbers import columns_of, texts, time_text


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a wide table."""
    timed = animation.times is not None or animation.fps is not None
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = TableWriter(file)
        columns = columns_of(animation)
        names = [f"{name}_{column}" for name in animation.names for column in columns]
        rows.writerow(["frame", *(["time"] if timed else []), *names])
        values = np.stack(list(columns.values()), axis=-1)
        for frame, time, row in zip(animation.frames, animation.seconds, values, strict=True):
            rows.writerow([frame, *([time_text(time)] if timed else []), *texts(row)])
