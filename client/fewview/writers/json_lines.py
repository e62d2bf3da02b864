"""JSON lines: first what holds for all frames, then a line for each.

The first line has `unit`, `fps`, `keypoint_names` and `edges`, null where unknown; the others have
`frame` (its number in the files, or from 0), `time` (seconds, null where unknown), `points`, each
[x, y, z] or null, and where it is known of any point `points_sd`, a number or null for each.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
        moments = zip(animation.frames, animation.seconds.tolist(), strict=True)
        for place, (frame, time) in enumerate(moments):
            points = _listed(animation.points[place], animation.seen[place])
            record = {"frame": frame, "time": time if timed else None, "points": points}
            if animation.points_sd is not None:
                sds = animation.points_sd[place]
                record["points_sd"] = _listed(sds, ~np.isnan(sds))
            file.write(json.dumps(record) + "\n")


def _listed(values: NDArray[np.float64], known: NDArray[np.bool_]) -> list[Any]:
    """Return P values, or rows of values, null where they are not known."""
    both = zip(values.tolist(), known.tolist(), strict=True)
    return [value if there else None for value, there in both]
