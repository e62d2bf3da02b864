"""CSV with a row for each point of each frame: frame, time, keypoint, x, y, z.

Frames have the numbers of the files, or count from 0; time (seconds) is left out where it is
unknown. A missing point has its row, with x, y and z empty. Comma and CRLF as in RFC 4180.
"""

from pathlib import Path

from fewview.animation import Animation
from fewview.plain import TableWriter
from fewview.writers.numbers import texts, time_text


def write(path: Path, animation: Animation) -> None:
    """Write an animation as a tidy table."""
    timed = animation.times is not None or animation.fps is not None
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = TableWriter(file)
        rows.writerow(["frame", *(["time"] if timed else []), "keypoint", "x", "y", "z"])
        for frame, time, points in zip(
            animation.frames, animation.seconds, animation.points, strict=True
        ):
            when = [frame, *([time_text(time)] if timed else [])]
            rows.writerows(
                [*when, name, *texts(point)]
                for name, point in zip(animation.names, points, strict=True)
            )
