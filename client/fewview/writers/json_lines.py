"""JSON lines: first what holds for all frames, then a line for each.

The first line has `unit`, `fps`, `keypoint_names` and `edges`, null where unknown; the others have
`frame` (its number in the files, or from 0), `time` (seconds, null where unknown) and `points`,
each [x, y, z] or null.
"""

import json
from pathlib import Path

from fewview.animation import Animation


def write(path: Path, animation: Animation) -> None:
    """Write an animation as JSON lines."""
    timed = animation.times is not None or animation.fps is not None
    header = {
        "unit": animation.unit,
        "fps": animation.fps,
        "keypoint_names": animation.keypoint_names,
        "edges": animation.edges,
    }
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(json.dumps(header, ensure_ascii=False) + "\n")
        for frame, time, points, seen in zip(
            animation.frames,
            animation.seconds.tolist(),
            animation.points,
            animation.seen,
            strict=True,
        ):
            listed = [
                point if there else None
                for point, there in zip(points.tolist(), seen.tolist(), strict=True)
            ]
            record = {"frame": frame, "time": time if timed else None, "points": listed}
            file.write(json.dumps(record) + "\n")
