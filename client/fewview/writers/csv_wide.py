"""CSV with a row for each frame: frame, time, then x, y, z of every keypoint.

Frames have the numbers of the files, or count from 0; time (seconds) is left out where it is
unknown. A missing point is empty. Comma and CRLF as in RFC 4180.
"""

from pathlib import Path

from fewview.animation import Animation
from fewview.plain import TableWriter
from fewview.writers.numbers import texts, time_text


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a wide table."""
    timed = animation.times is not None or animation.fps is not None
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = TableWriter(file)
        columns = [f"{name}_{axis}" for name in animation.names for axis in "xyz"]
        rows.writerow(["frame", *(["time"] if timed else []), *columns])
        for frame, time, points in zip(
            animation.frames, animation.seconds, animation.points, strict=True
        ):
            rows.writerow([frame, *([time_text(time)] if timed else []), *texts(points)])
